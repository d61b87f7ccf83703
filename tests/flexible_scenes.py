"""Flexible parts that several test files share: meshes, materials, holds, loads, and a rod with all loads."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import natcoord_jax as nc

# --- states -------------------------------------------------------------------------------------------------


def with_rows(state, rows=None, rates=None):
    """A state with other rows (nodes, 4, 3), and other velocities of them, where they are given."""
    q = state.q if rows is None else jnp.reshape(jnp.asarray(rows), state.q.shape)
    v = state.v if rates is None else jnp.reshape(jnp.asarray(rates), state.v.shape)
    return eqx.tree_at(lambda s: (s.q, s.v), state, (q, v))


def spun(state, spin, drift=(0.0, 0.0, 0.0)):
    """A state that moves as a rigid body about the origin."""
    rates = np.cross(spin, np.asarray(state.rows))
    rates[..., 0, :] += drift
    return with_rows(state, rates=rates)


def place_of(system, states, node):
    """Positions of a node [m]."""
    return np.asarray(system.sense(states, node).position)


def forces(system, state, rows):
    """Derivatives of the energy by rows (nodes, 4, 3)."""
    return jax.grad(lambda rows: system.energy(with_rows(state, rows)).potential)(jnp.asarray(rows))


def odd(values):
    """Linear part of what comes of a load and its opposite: even terms cancel."""
    values = np.asarray(values)
    return 0.5 * (values[0] - values[1])


def richardson(coarse, fine):
    """From results of order two at h and h/2."""
    return (4 * np.asarray(fine) - np.asarray(coarse)) / 3


# --- loads and holds ----------------------------------------------------------------------------------------


class Grows(eqx.Module):
    """A load in proportion to the load parameter; numbers change without another program."""

    value: Float[Array, "..."]

    def __call__(self, t):
        return self.value * t


class Pulse(eqx.Module):
    """A load that grows for half a second and fades in as long."""

    value: Float[Array, "..."]

    def __call__(self, t):
        return self.value * jnp.maximum(jnp.minimum(t, 1.0 - t), 0.0)


def grows(value):
    return Grows(jnp.asarray(value, float))


def push(scene, node, force):
    """A dead load that grows with the load parameter."""
    return scene.add(nc.PointForce((nc.Point(node),), force=grows(force)))


class DirectorInPlane(nc.Constraint):
    """A director that stays normal to a direction: symmetry."""

    kind = "director in plane"
    multipliers = 1

    def residual(self, x):
        """Cosine [-]."""
        return (x[0] @ x[1])[None]


def hold(scene, nodes, component):
    """Keep nodes in their planes across an axis."""
    for node, place in zip(nodes, np.asarray(nodes.positions)):
        plane = nc.Point(nc.ground, place), nc.Direction(nc.ground, np.eye(3)[component])
        scene.add(nc.PointOnPlane((*plane, nc.Point(node))))


def mirror(scene, nodes, directors, component):
    """The same with their directors: a plane of symmetry."""
    hold(scene, nodes, component)
    axis = nc.Direction(nc.ground, np.eye(3)[component])
    for node, director in zip(nodes, directors[nodes.numbers]):
        scene.add(DirectorInPlane((axis, nc.Direction(node, director))))


# --- meshes -------------------------------------------------------------------------------------------------


def triangulated(mesh):
    """Every quadrilateral as two triangles."""
    cells = mesh.cells
    halves = np.concatenate([cells[:, [0, 1, 2, 2]], cells[:, [0, 2, 3, 3]]])
    return nc.mesh.Mesh(mesh.nodes, halves, mesh.sets)


def mixed(mesh):
    """Every third quadrilateral as two triangles."""
    cells, some = mesh.cells, np.arange(len(mesh.cells)) % 3 == 0
    halves = np.concatenate([cells[some][:, [0, 1, 2, 2]], cells[some][:, [0, 2, 3, 3]]])
    return nc.mesh.Mesh(mesh.nodes, np.concatenate([cells[~some], halves]), mesh.sets)


def grid(counts, place):
    """A mesh of a square of parameters, with its four edges and all corners by number."""
    mesh = nc.mesh.rectangle((1.0, 1.0), counts)
    return nc.mesh.Mesh(np.array([place(u, v) for u, v, _ in mesh.nodes]), mesh.cells, mesh.sets)


def inner_nodes(mesh):
    """Which nodes are inside, of a flat mesh within its edges."""
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    return np.all((mesh.nodes > low + 1e-9) & (mesh.nodes < high - 1e-9) | (low == high), axis=1)


def distorted(mesh, size):
    """A mesh whose inner nodes are moved at random, of tetrahedra such that edges stay straight [m]."""
    random, inner = np.random.default_rng(1), inner_nodes(mesh)
    flat = np.ptp(mesh.nodes, axis=0) > 0
    nodes = mesh.nodes + inner[:, None] * flat * size * random.uniform(-1, 1, mesh.nodes.shape)
    if mesh.cells.shape[1] == 10:
        corners, middles = mesh.nodes[mesh.cells[0, :4]], mesh.nodes[mesh.cells[0, 4:]]
        pairs = [(a, b) for b in range(4) for a in range(b)]
        halves = np.array([0.5 * (corners[a] + corners[b]) for a, b in pairs])
        for k, middle in enumerate(middles):
            a, b = pairs[int(np.argmin(np.linalg.norm(halves - middle, axis=1)))]
            nodes[mesh.cells[:, 4 + k]] = 0.5 * (nodes[mesh.cells[:, a]] + nodes[mesh.cells[:, b]])
    assert not np.allclose(nodes, mesh.nodes), "nothing was moved"
    return nc.mesh.Mesh(nodes, mesh.cells, mesh.sets, mesh.faces)


# --- solids -------------------------------------------------------------------------------------------------

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
        return self.mu * (mixed + 0.25 * (c - 1.0) ** 2 - jnp.log(c))


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
"""Every element and every law, not all of one with all of the other."""

SHARES = {4: [1 / 4] * 4, 8: [-1 / 12] * 4 + [1 / 3] * 4, 9: [1 / 36] * 4 + [1 / 9] * 4 + [4 / 9]}
"""Of a rectangular face: what its nodes carry of a constant traction."""


def tractions(nodes, faces, traction):
    """Forces on nodes of a constant traction on rectangular faces."""
    loads = np.zeros_like(nodes)
    for face in faces:
        x = nodes[face[:4]]
        area = np.linalg.norm(np.cross(x[1] - x[0], x[3] - x[0]))
        loads[face] += area * np.outer(SHARES[len(face)], traction)
    return loads


MU = 997.5
STRETCHING = nc.CompressibleMooneyRivlin(c10=5 / 12 * MU, c01=MU / 12, density=10.0)


def l_shape(element, law, mass="lumped"):
    """A block like an L of four elements, pushed on two end faces, then free (case V04 of the references)."""
    cells = [
        nc.mesh.box(size, count, element=ELEMENTS[element])
        for size, count in (((6.0, 3.0, 3.0), (2, 1, 1)), ((3.0, 7.0, 3.0), (1, 2, 1)))
    ]
    nodes = np.concatenate([cells[0].nodes, cells[1].nodes + np.array([0.0, 3.0, 0.0])])
    mesh = nc.mesh.cleaned(nodes, np.concatenate([cells[0].cells, cells[1].cells + len(cells[0].nodes)]))
    traction, x = np.array([256.0, 512.0, 768.0]) / 9, mesh.nodes
    loads = np.zeros_like(x)
    for sign, axis, place in ((1, 0, 6.0), (-1, 1, 10.0)):
        faces = mesh.outside[np.all(x[mesh.outside, axis] == place, axis=1)]
        loads += tractions(x, faces, sign * traction)
    scene = nc.Scene()
    part = scene.add(nc.Solid(mesh, material=law, element=element, mass=mass))
    for node in np.flatnonzero(np.any(loads, axis=1)):
        scene.add(nc.PointForce((nc.Point(part.nodes[int(node)]),), force=Pulse(jnp.asarray(loads[node]))))
    return scene.compile()


# --- beams --------------------------------------------------------------------------------------------------

NUMBERS = {"EA": 1e4, "GA": (5e3, 4e3), "EI": (1.0, 2.0), "GJ": 1.5, "density": 2.0, "rotary": (0.01, 0.02)}
LINE = [(0, 0, 0), (1, 0, 0)]
BOTH = np.array([1.0, -1.0])
RAMP = np.array([0.5, 1.0])
CUTS = np.array([0.0, 0.2, 0.2 + 0.8 / 3, 0.2 + 1.6 / 3, 1.0])
"""Nodes of a rod of four elements: they are uneven, lest an error of the lengths cancels."""
AXES = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
"""Of the section of a rod, as columns: d_1, d_2, d_3 along y, z, x."""
NONE = (0.0, 0.0, 0.0)


def rod(section=None, curve=LINE, *, force=NONE, following=NONE, torque=NONE, gravity=NONE, **options):
    """A metre along x, clamped at its start, d_1 along y, with every load that there is at its end.

    All loads are there, as zeros, so that tests share programs.
    """
    section = nc.Section.of_numbers(**NUMBERS) if section is None else section
    scene, numbers = nc.Scene(), {"elements": 4, "stations": (0.2,), "second": (0, 1, 0)} | options
    beam = scene.add(nc.Beam(section, curve, start=nc.ground, name="rod", **numbers))
    last = beam.attachments[-1]
    point = nc.Point(beam.end, last.point)
    axes = [nc.Direction(beam.end, d) for d in jnp.asarray(last.axes).T]
    scene.add(nc.PointForce((point,), force=grows(force), name="dead"))
    scene.add(nc.PointForce((point, *axes), force=grows(following), following=True, name="following"))
    scene.add(nc.BodyTorque((axes[0],), torque=grows(torque), name="torque"))
    scene.add(nc.Gravity(vector=gravity))
    return *scene.compile(), beam


def solved(*args, loads=BOTH, **options):
    """System, equilibria and beam of a rod."""
    system, state, beam = rod(*args, **options)
    return system, nc.equilibrium(system, state, jnp.asarray(loads)).states, beam


def turn_of(rotations):
    """Small rotation vectors that take the first pose of a rod to these."""
    r = np.asarray(rotations) @ AXES.T
    return 0.5 * np.stack(
        [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1
    )


def scaled(system, beam, **factors):
    """A system with numbers of the elements of a beam times factors."""
    elements = list(beam.elements)
    return system.set(elements, **{k: x * system.get(elements, k) for k, x in factors.items()})
