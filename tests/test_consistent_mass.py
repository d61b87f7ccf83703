"""Mass between nodes: exact moments of inertia, one motion in all forms of the equations, exact balances."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped
from flexible_scenes import ELEMENTS, STRETCHING, l_shape

import natcoord_jax as nc
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.mechanics.full import FullStep
from natcoord_jax.mechanics.start_cache import NOTHING

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


@pytest.mark.parametrize("interpolation", WAYS)
@pytest.mark.parametrize("elements", [1, 4])
def test_a_rod_about_its_end_has_its_exact_inertia(interpolation, elements):
    system, state = rod(elements=elements, interpolation=interpolation, angular_velocity=(0, 0, 2.0))
    exact = MASS / 3 + ROTARY
    turning = np.asarray(system.angular_momentum(state))
    np.testing.assert_allclose(turning, [0, 0, 2.0 * exact], rtol=0, atol=1e-12 * exact)
    assert float(system.energy(state).kinetic) == pytest.approx(2.0 * exact, rel=1e-12)
    np.testing.assert_allclose(np.asarray(system.momentum(state)), [0, MASS, 0], rtol=0, atol=1e-12 * MASS)


@pytest.mark.parametrize("element", ELEMENTS)
def test_solids_have_their_exact_inertia(element):
    """Of a block that turns about the axis through its corner; lumped masses have too much or too little."""
    a, b, c = 1.0, 0.6, 0.5
    scene, mesh = nc.Scene(), nc.mesh.box((a, b, c), (2, 1, 1), element=ELEMENTS[element])
    material = nc.NeoHooke(E=2e6, nu=0.3, density=1200.0) if element.endswith(("P0", "P1")) else METAL
    given = dict(material=material, element=element, angular_velocity=(0, 0, 3.0), mass="consistent")
    scene.add(nc.Solid(mesh, **given))
    system, state = scene.compile()
    corner = mesh.nodes.min(axis=0)
    weight = 1200.0 * a * b * c

    def about(low, size):
        return ((low + size) ** 3 - low**3) / (3 * size)

    exact = weight * (about(corner[0], a) + about(corner[1], b))
    assert float(system.angular_momentum(state)[2]) == pytest.approx(3.0 * exact, rel=1e-12)
    assert float(system.energy(state).kinetic) == pytest.approx(4.5 * exact, rel=1e-12)


@pytest.mark.parametrize("triangles", [False, True])
@pytest.mark.parametrize("offset", [None, 0.02])
def test_shells_have_their_exact_inertia(triangles, offset):
    """About an axis in the plane: the points', the directors' and, with an offset, what is between them."""
    mesh = nc.mesh.rectangle((1.0, 0.5), (2, 2))
    if triangles:
        halves = [mesh.cells[:, corners] for corners in ([0, 1, 2, 2], [0, 2, 3, 3])]
        mesh = nc.mesh.Mesh(mesh.nodes, np.concatenate(halves))
    scene = nc.Scene()
    given = dict(thickness=0.04, offset=offset, angular_velocity=(0, 2.0, 0), mass="consistent")
    scene.add(nc.Shell(mesh, material=METAL, **given))
    system, state = scene.compile()
    weight, low = 1200.0 * 0.5 * 0.04, mesh.nodes[:, 0].min()
    across = 0.04**2 / 12 + (offset or 0.0) ** 2
    exact = weight * (((low + 1.0) ** 3 - low**3) / 3 + across)
    assert float(system.angular_momentum(state)[1]) == pytest.approx(2.0 * exact, rel=1e-12)


FORMS = ("full", "sparse", "reduced")


@pytest.mark.slow
def test_all_forms_give_the_same_motion():
    """A heavy rod that hangs on the ground falls; elimination along the tree is refused."""
    found = []
    for solver in FORMS:
        system, state = rod(solver=solver, start=nc.ground, weight=(0, 0, -9.81))
        trajectory = nc.simulate(system, state, dt=0.01, steps=20)
        assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SOLID
        found.append(np.asarray(trajectory.q))
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="without mass between bodies"):
        rod(solver="recursive")


SCHEMES = [
    nc.EnergyMomentum(order=4),
    nc.EnergyMomentum(kick=True),
    nc.VariationalMidpoint(),
    nc.Dissipative(spectral_radius=0.6),
]


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


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(
    "part",
    ["rod", pytest.param("plate", marks=pytest.mark.slow), pytest.param("block", marks=pytest.mark.slow)],
)
def test_all_schemes_keep_momenta(part, scheme):
    """All but the dissipative scheme keep energy, too, or nearly."""
    system, state = thrown(part)
    trajectory = nc.simulate(system, state, dt=0.01, steps=30, scheme=scheme)
    turning = np.asarray(system.angular_momentum(trajectory))
    assert np.ptp(turning, axis=0).max() <= 1e-12 * np.linalg.norm(turning[0])
    moving = np.asarray(system.momentum(trajectory))
    assert np.ptp(moving, axis=0).max() <= 1e-12 * np.linalg.norm(moving[0])
    energy = np.asarray(system.energy(trajectory).total)
    if isinstance(scheme, nc.EnergyMomentum):
        assert np.ptp(energy) <= 1e-12 * energy[0]


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("stages", [1, pytest.param(2, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("points", [False, True])
def test_the_jacobian_is_that_of_the_residual(stages, points):
    if points:
        scene = nc.Scene()
        scene.add(nc.Solid(nc.mesh.box((1, 1, 1), (1, 1, 1)), material=METAL, mass="consistent"))
        system, state = scene.compile(solver="full")
    else:
        system, state = rod(elements=2, solver="full", angular_velocity=(1.0, 2.0, 3.0))
    step = FullStep.prepare(system, state, jnp.zeros(0), jnp.array(0.05), gauss(stages), NOTHING)
    y = step.guess()
    y = y + 0.1 * jnp.asarray(np.random.default_rng(0).normal(size=y.shape))
    found, wanted = step.jacobian(y), jax.jacfwd(lambda y: step.residual(y)[0])(y)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-11 * float(jnp.max(jnp.abs(wanted))))


def test_weight_is_that_of_all_of_it():
    """Everything falls alike, and the potential energy is that of the mass in its centre."""
    system, state = rod(weight=(0, 0, -9.81), velocity=(1.0, 0, 0), elements=2)
    end = nc.simulate(system, state, dt=0.1, steps=5)[-1]
    fallen = np.asarray(end.q - state.q).reshape(-1, 4, 3)
    np.testing.assert_allclose(fallen[:, 0], [[0.5, 0, -9.81 / 8]] * 3, rtol=0, atol=1e-12)
    np.testing.assert_allclose(fallen[:, 1:], 0, atol=1e-12)
    potential = system.energy(end).potential - system.energy(state).potential
    assert float(potential) == pytest.approx(-MASS * 9.81**2 / 8, rel=1e-12)


def test_accelerations_and_reactions_are_those_of_a_short_step():
    system, state = rod(start=nc.ground, weight=(0, 0, -9.81))
    now, h = system.instant(state), 1e-8
    after = nc.simulate(system, state, dt=h, steps=1)
    gained = np.asarray(after.v[-1] - state.v) / h
    np.testing.assert_allclose(np.asarray(now.accelerations).reshape(gained.shape), gained, rtol=0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("mass", "side"), [("lumped", -1), ("consistent", 1)])
def test_frequencies_converge_from_both_sides(mass, side):
    """Of a rod along its axis, c / 4 l: lumped masses are too slow by (k h)^2 / 24, consistent too fast."""
    speed, errors = np.sqrt(1e9 / 1000.0), []
    for count in (4, 8):
        system, state = rod(mass, count, start=nc.ground)
        found = np.asarray(nc.modes(system, state).frequencies)
        exact = np.pi / 2 * speed
        errors.append(found[np.argmin(np.abs(found - exact))] / exact - 1.0)
        assert errors[-1] == pytest.approx(side * (np.pi / 2 / count) ** 2 / 24, rel=0.05)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.05)


@pytest.mark.slow
def test_masses_are_leaves():
    """A density that is set is as one that is given, for any number of systems; its derivative is exact."""

    def built(density):
        scene = nc.Scene()
        material = nc.Elastic(E=2e6, nu=0.3, density=density)
        block = nc.Solid(
            nc.mesh.box((1, 0.5, 0.5), (2, 1, 1)), material=material, mass="consistent", name="block"
        )
        held = scene.add(block)
        scene.add(nc.Clamp(nc.ground, held.set("x0")))
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

    both = jax.vmap(drop)(jnp.array([1200.0, 1500.0]))
    np.testing.assert_allclose(both, [drop(1200.0), drop(1500.0)], rtol=1e-12)
    assert_v_shaped(drop, jnp.array(1200.0), jnp.array(100.0), jax.grad(drop)(1200.0) * 100.0)


class Rope(nc.Spring):
    """A spring whose own mass moves as its ends do, linearly between them."""

    kind = "rope"

    def mass_matrix(self):
        """Of a mass of three kilograms."""
        return 0.5 * jnp.array([[2.0, 1.0], [1.0, 2.0]])[:, None, :, None]


def test_an_element_of_ones_own_brings_mass_between_bodies():
    """A mass of one kilogram on a heavy spring: the mass of the spring counts by a third."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, position=(1.0, 0, 0)))
    scene.add(Rope((nc.Point(nc.ground), nc.Point(ball)), stiffness=400.0, length=1.0))
    system, state = scene.compile()
    found = np.asarray(nc.modes(system, state).frequencies)
    assert found[-1] == pytest.approx(np.sqrt(400.0 / 2.0), rel=1e-12)


# V04 of the references with the masses of its prototype: energy after the pulse [J].
TUMBLING = [("Hexahedron8", 313.1255), ("Hexahedron20", 359.3695)]


@pytest.mark.slow
@pytest.mark.parametrize(("element", "energy"), TUMBLING)
def test_an_l_shape_tumbles_as_its_prototype(element, energy):
    system, state = l_shape(element, STRETCHING, mass="consistent")
    found = nc.simulate(system, state, dt=0.25, steps=12)
    after = np.asarray(system.energy(found[4:]).total) - float(system.energy(state).total)
    np.testing.assert_allclose(after, energy, rtol=1e-6)


def test_without_it_nothing_changes():
    """Lumped masses leave the system as it was: there is nothing between bodies."""
    system, state = rod("lumped")
    assert system.mass_between is None
    none = replace_fields(system, mass_between=None)
    assert jax.tree.structure(none) == jax.tree.structure(system)


class Light(nc.ShellElement):
    """A shell whose directors have no mass."""

    kind = "light shell"

    def mass_matrix(self):
        """Of the points."""
        return self.material.density * self.thickness * self.areas


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
