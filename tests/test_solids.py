"""Solids: hyperelastic laws, quadratic elements, nearly incompressible materials, and meshes of gmsh."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
import natcoord_jax.io
from natcoord_jax.core.cells import TETRAHEDRON_EDGES
from natcoord_jax.core.force import Load
from natcoord_jax.effects.loads.curved_pressure import face_table
from natcoord_jax.maths.symmetric import PAIRS

FIRST, SECOND = np.array(PAIRS).T
DENSITY = 1000.0


class Gent(nc.Hyperelastic):
    """A law of one's own (A. N. Gent, Rubber Chem. Technol. 69 (1996) 59-61), with a volume term apart."""

    mu: float = eqx.field(default=4e3, kw_only=True)
    split = True

    def energy(self, C, G, c):
        return -10.0 * self.mu * jnp.log1p(-(jnp.trace(C) * c ** (-1 / 3) - 3.0) / 20.0)

    def volumetric(self, J):
        return self.mu * jnp.log(J) ** 2


class Tissue(nc.Hyperelastic):
    """Another, that depends on all of its arguments at once."""

    mu: float = eqx.field(default=2e3, kw_only=True)

    def energy(self, C, G, c):
        mixed = jnp.trace(C) * jnp.trace(G) / 9.0 - 1.0 + (C[0, 1] - C[1, 2]) ** 2
        return self.mu * (mixed + 0.25 * (c - 1.0) ** 2 - 2.0 * jnp.log(c))


SMALL = {"E": 1e4, "nu": 0.3, "density": DENSITY}
LAWS = {
    "elastic": nc.Elastic(**SMALL),
    "neo-Hooke": nc.NeoHooke(**SMALL),
    "Mooney-Rivlin": nc.MooneyRivlin(c10=1.5e3, c01=5e2, bulk_modulus=8e3, density=DENSITY),
    "compressible": nc.CompressibleMooneyRivlin(c10=1.5e3, c01=5e2, volume_stiffness=1e3, density=DENSITY),
    "Ogden": nc.Ogden(
        moduli=(3e3, 20.0, -100.0), exponents=(1.3, 5.0, -2.0), bulk_modulus=8e3, density=DENSITY
    ),
    "fibres": nc.TransverselyIsotropic(**SMALL, fibre_stiffness=2e4, direction=(1.0, 2.0, 0.5)),
    "Gent": Gent(density=DENSITY),
    "tissue": Tissue(density=DENSITY),
}
ELEMENTS = {
    "Brick": "hexahedron8",
    "Hexahedron8": "hexahedron8",
    "Hexahedron20": "hexahedron20",
    "Hexahedron27": "hexahedron27",
    "Hexahedron27P1": "hexahedron27",
    "Tetrahedron10": "tetrahedron10",
    "Tetrahedron10P0": "tetrahedron10",
}
PAIRED = [("Brick", "elastic")]
PAIRED += [(e, "elastic") for e in ELEMENTS if e != "Brick" and "P" not in e]
PAIRED += [(e, "neo-Hooke") for e in ELEMENTS if e != "Brick"]
PAIRED += [("Hexahedron8", law) for law in LAWS if law not in ("elastic", "neo-Hooke")]
PAIRED += [("Hexahedron27P1", "Ogden"), ("Hexahedron27P1", "Gent"), ("Tetrahedron10P0", "Mooney-Rivlin")]


def inner_moved(mesh, size):
    """A mesh whose inner nodes are moved at random, of tetrahedra such that edges stay straight."""
    random = np.random.default_rng(1)
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    inner = np.all((mesh.nodes > low + 1e-9) & (mesh.nodes < high - 1e-9), axis=1)
    nodes = mesh.nodes + inner[:, None] * size * random.uniform(-1, 1, mesh.nodes.shape)
    if mesh.cells.shape[1] == 10:
        for k, (a, b) in enumerate(TETRAHEDRON_EDGES):
            nodes[mesh.cells[:, 4 + k]] = 0.5 * (nodes[mesh.cells[:, a]] + nodes[mesh.cells[:, b]])
    assert not np.allclose(nodes, mesh.nodes), "nothing was moved"
    return nc.mesh.Mesh(nodes, mesh.cells, mesh.sets, mesh.faces)


def placed(system, part, places):
    """A start with the nodes of a part at given places."""
    system, state = system.compile()
    rows = np.asarray(state.q).reshape(-1, 4, 3).copy()
    rows[:, 0] = places
    return system, nc.State(**{**vars(state), "q": jnp.asarray(rows.reshape(-1, 3))})


def density_of(law, f):
    """Energy per volume by a deformation gradient."""
    strain = (0.5 * (f.T @ f - jnp.eye(3)))[FIRST, SECOND] * np.where(FIRST == SECOND, 1.0, 2.0)
    return law.energy_density(strain[:, None])[0]


@pytest.mark.parametrize(("element", "law"), PAIRED)
def test_patch(element, law):
    """A uniform deformation of a distorted mesh: no forces on inner nodes, and the stress of the law."""
    mesh = inner_moved(nc.mesh.box((1.0, 0.8, 0.6), (2, 2, 2), element=ELEMENTS[element]), 0.05)
    scene = nc.Scene()
    part = scene.add(nc.Solid(mesh, material=LAWS[law], element=element))
    gradient = np.array([(1.1, 0.2, -0.1), (0.05, 0.9, 0.15), (0.0, -0.1, 1.2)])
    system, state = placed(scene, part, mesh.nodes @ gradient.T)
    forces = jax.grad(lambda q: system.energy(nc.State(**{**vars(state), "q": q})).total)(state.q)
    forces = np.asarray(forces).reshape(-1, 4, 3)[:, 0]
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    inner = np.all((mesh.nodes > low + 1e-9) & (mesh.nodes < high - 1e-9), axis=1)
    assert inner.any()
    assert np.abs(forces[inner]).max() <= 10 * tol.INDIFFERENCE * np.abs(forces).max()
    first = jax.grad(lambda f: density_of(LAWS[law], f))(jnp.asarray(gradient))
    stress = first @ gradient.T / np.linalg.det(gradient)
    found = system.sense(state, part)
    assert np.abs(found.stress - stress).max() <= 100 * tol.INDIFFERENCE * np.abs(stress).max()
    energy = 0.48 * density_of(LAWS[law], jnp.asarray(gradient))
    assert float(system.energy(state).total) == pytest.approx(float(energy), rel=tol.INDIFFERENCE)


@pytest.mark.parametrize("law", LAWS)
def test_work_of_the_stress_of_a_step(law):
    """It is the change of energy, however large the step; of a small one the stress is the derivative."""
    random = np.random.default_rng(2)
    law = LAWS[law]

    def energy(strain):
        return law.energy_density(strain[:, None])[0]

    for size in (0.3, 1e-4):
        f = np.eye(3) + 0.2 * random.normal(size=(2, 3, 3)) * np.array([1.0, size])[:, None, None]
        f[1] = f[0] + size * (f[1] - np.eye(3))
        start, end = (
            jnp.asarray((0.5 * (x.T @ x - np.eye(3)))[FIRST, SECOND] * np.where(FIRST == SECOND, 1, 2))
            for x in f
        )
        stress = law.mean_stress(start[:, None], (end - start)[:, None])[:, 0]
        scale = float(jnp.sum(jnp.abs(stress * (end - start))))
        assert abs(float(stress @ (end - start) - energy(end) + energy(start))) <= 1e-11 * 1e4 * max(
            1e-5, scale * 1e-3
        )
    at = jax.grad(energy)(start)
    limit = law.mean_stress(start[:, None], jnp.zeros((6, 1)))[:, 0]
    np.testing.assert_allclose(limit, at, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(jax.grad(energy)(jnp.zeros(6)), 0.0, atol=1e-9)
    shear = jax.hessian(energy)(jnp.zeros(6))
    assert np.linalg.eigvalsh(shear).min() > 0


def tumbling(element, law, **given):
    """A block that flies, turns and is shaken."""
    size = 1 if ELEMENTS[element] != "hexahedron8" else 2
    mesh = nc.mesh.box((1.0, 0.5, 0.5), (size, 1, 1), element=ELEMENTS[element])
    shaken = 0.6 * np.random.default_rng(0).normal(size=mesh.nodes.shape)
    scene = nc.Scene()
    scene.add(
        nc.Solid(
            mesh, material=LAWS[law], element=element, velocity=shaken, angular_velocity=(1, 2, 3), **given
        )
    )
    return scene.compile()


def conserved(system, trajectory):
    found = nc.balance(system, trajectory)
    assert found.energy.max() <= tol.ENERGY_OF_A_SOLID
    assert found.momentum.max() <= tol.MOMENTUM_OF_A_SOLID
    assert found.angular_momentum.max() <= tol.MOMENTUM_OF_A_SOLID
    energy = system.energy(trajectory)
    stored = np.asarray(energy.total - energy.kinetic)
    assert stored.max() >= 0.02 * float(energy.total[0]), "it hardly moves"


@pytest.mark.parametrize(
    ("element", "law"), [("Hexahedron8", "neo-Hooke"), ("Hexahedron8", "tissue"), ("Tetrahedron10P0", "Gent")]
)
def test_a_block_in_motion(element, law):
    system, state = tumbling(element, law)
    conserved(system, nc.simulate(system, state, dt=0.02, steps=50))


@pytest.mark.slow
@pytest.mark.parametrize(("element", "law"), PAIRED)
def test_every_element_and_law_in_motion(element, law):
    system, state = tumbling(element, law)
    conserved(system, nc.simulate(system, state, dt=0.01, steps=1000))


# --- statics ----------------------------------------------------------------------------------------------


class NodeLoad(nc.Force):
    """A dead force on a node that grows with the load parameter."""

    force: jax.Array = eqx.field(kw_only=True)
    kind = "node load"

    def load(self, x, rate, inputs, t):
        return Load(t * self.force[None], None)


def held(scene, part, nodes, axis):
    """Nodes that stay in their plane normal to an axis."""
    table = nc.Point(nc.ground), nc.Direction(nc.ground, np.eye(3)[axis])
    for node in nodes:
        place = np.asarray(part.nodes.positions)[int(node)]
        scene.add(nc.PointOnPlane((*table, nc.Point(part.nodes[int(node)])), distance=float(place[axis])))


def consistent(nodes, faces, traction):
    """Forces on nodes of a constant traction on faces of eight or nine nodes, or of four."""
    forces = np.zeros_like(nodes)
    for face in faces:
        x = nodes[face]
        if len(face) == 4:
            area = 0.5 * np.linalg.norm(np.cross(x[2] - x[0], x[3] - x[1]))
            forces[face] += 0.25 * area * traction
        else:
            values, slopes, weights = face_table(len(face))
            one, other = (np.einsum("gk,kx->gx", slopes[:, :, k], x) for k in (0, 1))
            areas = weights * np.linalg.norm(np.cross(one, other), axis=1)
            forces[face] += np.outer(values.T @ areas, traction)
    return forces


def cook(element, count, nu):
    """Cook's membrane in plane strain: how far the middle of the loaded edge moves up [mm]."""
    box = nc.mesh.box((1.0, 1.0, 1.0), (count, count, 1), element=ELEMENTS[element])
    u, v, w = box.nodes.T
    nodes = np.stack([48 * u, 44 * u + v * (44 - 28 * u), w], axis=1)
    mesh = nc.mesh.Mesh(nodes, box.cells, box.sets, box.faces)
    scene = nc.Scene()
    rubber = nc.NeoHooke(E=2 * 0.4225 * (1 + nu), nu=nu, density=1.0)
    part = scene.add(nc.Solid(mesh, material=rubber, element=element))
    scene.add(nc.Clamp(nc.ground, part.set("x0")))
    layers = np.union1d(mesh.sets["z0"], mesh.sets["z1"])
    held(scene, part, np.setdiff1d(layers, mesh.sets["x0"]), 2)
    forces = consistent(nodes, mesh.faces["x1"], np.array([0.0, 1 / 16, 0.0]))
    loaded = np.flatnonzero(forces[:, 1])
    scene.add(NodeLoad.on(part.nodes, loaded[:, None], each={"force": forces[loaded]}))
    system, state = scene.compile()
    end = nc.equilibrium(system, state, steps=2 if nu < 0.4 else 8).state
    middle = part.nearest((48.0, 52.0, 0.0))
    return float(system.sense(end, middle).position[1]) - 52.0


COOK = [
    ("Hexahedron8", 2, 0.3, 8.638),
    ("Hexahedron27P1", 2, 0.4999, 11.889),
]
COOK_SLOW = [
    ("Hexahedron8", 4, 0.3, 12.071),
    ("Hexahedron8", 8, 0.3, 13.863),
    ("Hexahedron20", 2, 0.3, 13.913),
    ("Hexahedron27", 2, 0.3, 14.302),
    ("Hexahedron27", 4, 0.3, 14.649),
    ("Hexahedron27P1", 2, 0.3, 14.663),
    ("Hexahedron8", 4, 0.4999, 4.11),
    ("Hexahedron27P1", 4, 0.4999, 11.954),
]


@pytest.mark.parametrize(("element", "count", "nu", "published"), COOK)
def test_cooks_membrane(element, count, nu, published):
    assert cook(element, count, nu) == pytest.approx(published, abs=tol.COOK)


@pytest.mark.slow
@pytest.mark.parametrize(("element", "count", "nu", "published"), COOK_SLOW)
def test_cooks_membrane_on_finer_meshes(element, count, nu, published):
    assert cook(element, count, nu) == pytest.approx(published, abs=tol.COOK)
