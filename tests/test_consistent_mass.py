"""Mass between nodes: exact moments of inertia, exact balances with all schemes, frequencies, derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped
from flexible_scenes import ELEMENTS

import natcoord_jax as nc


def lane(case, default=()):
    """An entry of a table, marked by its lane."""
    marks = [] if case in default else [pytest.mark.exhaustive]
    return pytest.param(*case, marks=marks)


ROD = nc.CircularSection(radius=0.05, E=1e9, density=1000.0)
MASS, ROTARY = np.pi * 0.05**2 * 1000.0, np.pi * 0.05**4 / 4 * 1000.0
METAL = nc.Elastic(E=2e6, nu=0.3, density=1200.0)
WAYS = [nc.RelativeMotion(), nc.DirectorInterpolation(order=1), nc.DirectorInterpolation(order=3)]


def rod(mass="consistent", elements=3, *, solver=None, weight=(0.0, 0.0, 0.0), **options):
    """A rod along the first axis."""
    scene = nc.Scene()
    scene.add(nc.Beam(ROD, [(0, 0, 0), (1, 0, 0)], elements=elements, mass=mass, name="rod", **options))
    scene.add(nc.Gravity(vector=weight))
    return scene.compile(solver=solver)


@pytest.mark.parametrize(
    ("way", "elements"), [lane((way, n), {(0, 4)}) for way in range(len(WAYS)) for n in (1, 4)]
)
def test_a_rod_about_its_end_has_its_exact_inertia(way, elements):
    system, state = rod(elements=elements, interpolation=WAYS[way], angular_velocity=(0, 0, 2.0))
    exact = MASS / 3 + ROTARY
    turning = np.asarray(system.angular_momentum(state))
    np.testing.assert_allclose(turning, [0, 0, 2.0 * exact], rtol=0, atol=1e-12 * exact)
    assert float(system.energy(state).kinetic) == pytest.approx(2.0 * exact, rel=1e-12)
    np.testing.assert_allclose(np.asarray(system.momentum(state)), [0, MASS, 0], rtol=0, atol=1e-12 * MASS)


@pytest.mark.parametrize("element", [lane((e,), {("Hexahedron8",)}) for e in ELEMENTS])
def test_solids_have_their_exact_inertia(element):
    """Of a block that turns about the axis through its corner; lumped masses have too much or too little."""
    a, b, c = 1.0, 0.6, 0.5
    scene, mesh = nc.Scene(), nc.mesh.box((a, b, c), (2, 1, 1), element=ELEMENTS[element])
    material = nc.NeoHooke(E=2e6, nu=0.3, density=1200.0) if element.endswith(("P0", "P1")) else METAL
    options = dict(material=material, element=element, angular_velocity=(0, 0, 3.0), mass="consistent")
    scene.add(nc.Solid(mesh, **options))
    system, state = scene.compile()
    corner = mesh.nodes.min(axis=0)
    weight = 1200.0 * a * b * c

    def about(low, size):
        return ((low + size) ** 3 - low**3) / (3 * size)

    exact = weight * (about(corner[0], a) + about(corner[1], b))
    assert float(system.angular_momentum(state)[2]) == pytest.approx(3.0 * exact, rel=1e-12)
    assert float(system.energy(state).kinetic) == pytest.approx(4.5 * exact, rel=1e-12)


@pytest.mark.parametrize(
    ("triangles", "offset"), [lane((t, o), {(False, 0.02)}) for t in (False, True) for o in (None, 0.02)]
)
def test_shells_have_their_exact_inertia(triangles, offset):
    """About an axis in the plane: the points', the directors' and, with an offset, what is between them."""
    mesh = nc.mesh.rectangle((1.0, 0.5), (2, 2))
    if triangles:
        halves = [mesh.cells[:, corners] for corners in ([0, 1, 2, 2], [0, 2, 3, 3])]
        mesh = nc.mesh.Mesh(mesh.nodes, np.concatenate(halves))
    scene = nc.Scene()
    options = dict(thickness=0.04, offset=offset, angular_velocity=(0, 2.0, 0), mass="consistent")
    scene.add(nc.Shell(mesh, material=METAL, **options))
    system, state = scene.compile()
    weight, low = 1200.0 * 0.5 * 0.04, mesh.nodes[:, 0].min()
    across = 0.04**2 / 12 + (offset or 0.0) ** 2
    exact = weight * (((low + 1.0) ** 3 - low**3) / 3 + across)
    assert float(system.angular_momentum(state)[1]) == pytest.approx(2.0 * exact, rel=1e-12)


SCHEMES = {
    "order 4": nc.EnergyMomentum(order=4),
    "order 2 with kicks": nc.EnergyMomentum(kick=True),
    "variational": nc.VariationalMidpoint(),
    "dissipative": nc.Dissipative(spectral_radius=0.6),
}


def thrown(part):
    """A part that is thrown and turns; its nodes are triads, directors or points."""
    thrown = {"angular_velocity": (1.0, 2.0, 3.0), "velocity": (0.0, 1.0, 0.0)}
    if part == "rod":
        return rod(**thrown)
    thrown |= {"material": nc.Elastic(E=2e6, nu=0.3, density=1000.0), "mass": "consistent"}
    scene = nc.Scene()
    if part == "plate":
        scene.add(nc.Shell(nc.mesh.rectangle((1.0, 0.5), (2, 1)), thickness=0.05, **thrown))
    else:
        scene.add(nc.Solid(nc.mesh.box((1.0, 0.5, 0.5), (1, 1, 1)), **thrown))
    return scene.compile()


@pytest.mark.parametrize(
    ("part", "scheme"),
    [lane((part, scheme)) for part in ("rod", "plate", "block") for scheme in SCHEMES],
)
def test_all_schemes_keep_momenta(part, scheme):
    """All but the dissipative scheme keep energy, too, or nearly."""
    system, state = thrown(part)
    trajectory = nc.simulate(system, state, dt=0.01, steps=30, scheme=SCHEMES[scheme])
    turning = np.asarray(system.angular_momentum(trajectory))
    assert np.ptp(turning, axis=0).max() <= 1e-12 * np.linalg.norm(turning[0])
    moving = np.asarray(system.momentum(trajectory))
    assert np.ptp(moving, axis=0).max() <= 1e-12 * np.linalg.norm(moving[0])
    energy = np.asarray(system.energy(trajectory).total)
    if isinstance(SCHEMES[scheme], nc.EnergyMomentum):
        assert np.ptp(energy) <= 1e-12 * energy[0]


@pytest.mark.exhaustive
def test_elements_of_every_kind_fly():
    """A plate, a block and a rod in one scene, some of them on the sparse plan, over a thousand steps."""
    scene = nc.Scene()
    spin = dict(angular_velocity=(1.0, -2.0, 0.5), mass="consistent")
    scene.add(nc.Shell(nc.mesh.rectangle((1.0, 0.5), (2, 1)), thickness=0.02, material=METAL, **spin))
    scene.add(nc.Solid(nc.mesh.box((1, 0.5, 0.5), (2, 1, 1)), material=METAL, position=(0, 2, 0), **spin))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.02, steps=1000, save_every=50)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SOLID
    turning = np.asarray(system.angular_momentum(trajectory))
    assert np.ptp(turning, axis=0).max() <= tol.MOMENTUM_OF_A_SOLID * np.linalg.norm(turning[0])


@pytest.mark.exhaustive
def test_weight_is_that_of_all_of_it():
    """Everything falls alike, and the potential energy is that of the mass in its centre."""
    system, state = rod(weight=(0, 0, -9.81), velocity=(1.0, 0, 0), elements=2)
    end = nc.simulate(system, state, dt=0.1, steps=5)[-1]
    fallen = np.asarray(end.q - state.q).reshape(-1, 4, 3)
    np.testing.assert_allclose(fallen[:, 0], [[0.5, 0, -9.81 / 8]] * 3, rtol=0, atol=1e-12)
    np.testing.assert_allclose(fallen[:, 1:], 0, atol=1e-12)
    potential = system.energy(end).potential - system.energy(state).potential
    assert float(potential) == pytest.approx(-MASS * 9.81**2 / 8, rel=1e-12)


@pytest.mark.exhaustive
def test_accelerations_and_reactions_are_those_of_a_short_step():
    system, state = rod(start=nc.ground, weight=(0, 0, -9.81))
    now, h = system.instant(state), 1e-8
    after = nc.simulate(system, state, dt=h, steps=1)
    gained = np.asarray(after.v[-1] - state.v) / h
    np.testing.assert_allclose(np.asarray(now.accelerations).reshape(gained.shape), gained, rtol=0, atol=1e-3)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("mass", "side"), [("lumped", -1), ("consistent", 1)])
def test_frequencies_converge_from_both_sides(mass, side):
    """Of a rod along its axis, c / 4 l: lumped masses are too slow by (k h)^2 / 24, consistent too fast."""
    speed, errors = np.sqrt(1e9 / 1000.0), []
    for count in (4, 8):
        system, state = rod(mass, count, start=nc.ground)
        result = np.asarray(nc.modes(system, state).frequencies)
        exact = np.pi / 2 * speed
        errors.append(result[np.argmin(np.abs(result - exact))] / exact - 1.0)
        assert errors[-1] == pytest.approx(side * (np.pi / 2 / count) ** 2 / 24, rel=0.05)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.05)


@pytest.mark.exhaustive
def test_masses_are_leaves():
    """A density that is set is as one that is given, for any number of systems; its derivative is exact."""

    def built(density):
        scene = nc.Scene()
        material = nc.Elastic(E=2e6, nu=0.3, density=density)
        block = nc.Solid(
            nc.mesh.box((1, 0.5, 0.5), (2, 1, 1)), material=material, mass="consistent", name="block"
        )
        block = scene.add(block)
        scene.add(nc.Clamp(nc.ground, block.set("x0")))
        scene.add(nc.Gravity())
        return scene.compile()

    system, state = built(1200.0)
    other, _ = built(1500.0)
    heavier = system.set("block", **{"material.density": 1500.0})
    np.testing.assert_allclose(heavier.mass, other.mass, rtol=1e-14)
    np.testing.assert_allclose(heavier.mass_between.blocks, other.mass_between.blocks, rtol=1e-14)

    @nc.jit
    def drop(density):
        changed = system.set("block", **{"material.density": density})
        return nc.simulate(changed, state, dt=0.01, steps=5, throw=False).q[-1, :, 2].sum()

    drops = jax.vmap(drop)(jnp.array([1200.0, 1500.0]))
    np.testing.assert_allclose(drops, [drop(1200.0), drop(1500.0)], rtol=1e-12)
    assert_v_shaped(drop, jnp.array(1200.0), jnp.array(100.0), jax.grad(drop)(1200.0) * 100.0)


class Rope(nc.Spring):
    """A spring whose own mass moves as its ends do, linearly between them."""

    kind = "rope"

    def mass_matrix(self):
        """Of a mass of three kilograms."""
        return 0.5 * jnp.array([[2.0, 1.0], [1.0, 2.0]])[:, None, :, None]


@pytest.mark.exhaustive
def test_an_element_of_ones_own_brings_mass_between_bodies():
    """A mass of one kilogram on a heavy spring: the mass of the spring counts by a third."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, position=(1.0, 0, 0)))
    scene.add(Rope((nc.Point(nc.ground), nc.Point(ball)), stiffness=400.0, length=1.0))
    system, state = scene.compile()
    result = np.asarray(nc.modes(system, state).frequencies)
    assert result[-1] == pytest.approx(np.sqrt(400.0 / 2.0), rel=1e-12)


class Pulse(nc.Force):
    """A dead force on a node that grows for half a second and fades in as long."""

    force: jax.Array = eqx.field(kw_only=True)
    kind = "pulse of a node"

    def load(self, x, rate, inputs, t):
        """By the time."""
        return nc.Load(jnp.maximum(jnp.minimum(t, 1.0 - t), 0.0) * self.force[None], None)


MU = 997.5
STRETCHING = nc.CompressibleMooneyRivlin(c10=5 / 12 * MU, c01=MU / 12, density=10.0)
SHARES = {4: [0.25] * 4, 8: [-1 / 12] * 4 + [1 / 3] * 4}
"""Of a force that is spread over a plane face, by node: corners first."""

# V04 of the references with the masses of its prototype: energy after the pulse [J].
TUMBLING = [("Hexahedron8", 313.1255), ("Hexahedron20", 359.3695)]


@pytest.mark.exhaustive
@pytest.mark.parametrize(("element", "energy"), TUMBLING)
def test_an_l_shape_tumbles_as_its_prototype(element, energy):
    """A block like an L of four elements, pushed on two end faces, then free."""
    sizes = ((6.0, 3.0, 3.0), (2, 1, 1)), ((3.0, 7.0, 3.0), (1, 2, 1))
    cells = [nc.mesh.box(size, count, element=ELEMENTS[element]) for size, count in sizes]
    nodes = np.concatenate([cells[0].nodes, cells[1].nodes + np.array([0.0, 3.0, 0.0])])
    mesh = nc.mesh.cleaned(nodes, np.concatenate([cells[0].cells, cells[1].cells + len(cells[0].nodes)]))
    force, x = np.array([256.0, 512.0, 768.0]), mesh.nodes  # of either face, three metres square
    forces = np.zeros_like(x)
    for sign, axis, place in ((1, 0, 6.0), (-1, 1, 10.0)):
        for face in mesh.outside[np.all(x[mesh.outside, axis] == place, axis=1)]:
            forces[face] += np.outer(SHARES[len(face)], sign * force)
    scene = nc.Scene()
    part = scene.add(nc.Solid(mesh, material=STRETCHING, element=element, mass="consistent"))
    loaded = np.flatnonzero(np.any(forces, axis=1))
    scene.add(Pulse.on(part.nodes, loaded[:, None], each={"force": forces[loaded]}))
    system, state = scene.compile()
    result = nc.simulate(system, state, dt=0.25, steps=12)
    after = np.asarray(system.energy(result[4:]).total) - float(system.energy(state).total)
    np.testing.assert_allclose(after, energy, rtol=1e-6)


def test_without_it_nothing_changes():
    """Lumped masses leave the system as it was: there is nothing between bodies."""
    assert rod("lumped")[0].mass_between is None


class Light(nc.ShellElement):
    """A shell whose directors have no mass."""

    kind = "light shell"

    def mass_matrix(self):
        """Of the points."""
        return self.material.density * self.thickness * self.areas


@pytest.mark.exhaustive
def test_directors_without_mass():
    """They turn as the stresses ask for; energy and momenta of a flying plate stay exact."""
    scene, mesh = nc.Scene(), nc.mesh.rectangle((1.0, 0.5), (3, 2))
    spin = np.array([1.0, 0.5, 2.0])
    moving = dict(velocity=np.cross(spin, mesh.nodes), angular_velocity=spin)
    nodes = scene.add(nc.Nodes.directors(mesh.nodes, (0, 0, 1.0), **moving))
    scene.add(Light.on(nodes, mesh.cells, thickness=0.02, material=nc.Elastic(E=2e7, nu=0.3, density=1000.0)))
    system, state = scene.compile()
    assert float(jnp.max(jnp.abs(system.mass[:, 1:, 1:]))) == 0.0
    trajectory = nc.simulate(system, state, dt=0.01, steps=200)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SOLID
    turning = np.asarray(system.angular_momentum(trajectory))
    assert np.ptp(turning, axis=0).max() <= tol.MOMENTUM_OF_A_SOLID * np.linalg.norm(turning[0])
    assert float(trajectory.iterations) <= 6 * 200
