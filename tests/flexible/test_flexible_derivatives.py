"""Derivatives of motions, equilibria, frequencies, paths by all numbers of what bends: V-shaped differences.

Could go wrong: stiffness, masses or unstressed shapes that are no functions of the numbers that they are made
of, places without a derivative where all is at rest and unstrained, rates along a path for derivatives.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import tolerances as tol
from differences import assert_v_shaped
from flexible_scenes import DENSITY, ELEMENTS, LINE, NUMBERS, push, rod, scaled
from jaxtyping import Array, Float
from test_beam_statics import shallow_arch

import natcoord_jax as nc


def named(name, *arguments, **options):
    """The same with the name of the number in the message."""
    try:
        assert_v_shaped(*arguments, **options)
    except AssertionError as error:
        raise AssertionError(f"{name}: {error}") from None


# --- motions ------------------------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_a_rope_that_starts_at_rest_and_unstrained():
    """Values and derivatives are finite where rotations, strains and velocities are exactly zero."""
    scene, section = nc.Scene(), nc.CircularSection(radius=0.01, E=1e6, density=1000.0)
    rope = scene.add(nc.Beam(section, LINE, elements=2, name="rope"))
    scene.add(nc.Spherical(nc.ground, rope.start))
    scene.add(nc.Gravity())
    system, state = scene.compile()

    def drop(factor):
        softer = scaled(system, rope, stiffness=factor)
        return softer.sense(nc.simulate(softer, state, dt=1e-2, steps=5), rope.end).position[-1, 2]

    one, graded = jnp.ones(()), jax.jit(jax.value_and_grad(drop))
    assert_v_shaped(lambda x: graded(x)[0], one, one, graded(one)[1])


SHELL = ("thickness", "E", "density", "reference")


@pytest.mark.exhaustive
def test_motion_by_the_numbers_of_a_shell():
    """Of where a corner is after some steps, by what its stiffness and masses are made of: one program."""
    scene, mesh = nc.Scene(), nc.mesh.rectangle((1.0, 0.5), (3, 2))
    metal = nc.Elastic(E=2e5, nu=0.3, density=1200.0)
    part = scene.add(nc.Shell(mesh, thickness=0.02, material=metal, name="body"))
    scene.add(nc.Clamp(nc.ground, part.set("left")))
    scene.add(nc.Gravity())
    system, state = scene.compile()
    tip, numbers = part.nearest((1.0, 0.5, 0.0)), {key: system.get(part, key) for key in SHELL}

    @jax.jit
    def last(factors):
        changed = system.set(part, **{key: factors[k] * numbers[key] for k, key in enumerate(SHELL)})
        trajectory = nc.simulate(changed, state, dt=5e-3, steps=10)
        return changed.sense(trajectory, tip).position[-1, 2]

    ones = jnp.ones(len(SHELL))
    slopes = jax.jit(jax.grad(last))(ones)
    for k, name in enumerate(SHELL):
        named(name, last, ones, jnp.eye(len(SHELL))[k], slopes[k])


class History(eqx.Module):
    """A force through given values [N] at equal times, linear between them."""

    times: Float[Array, " n"]
    values: Float[Array, "n 3"]

    def __call__(self, t):
        return jax.vmap(lambda column: jnp.interp(t, self.times, column), in_axes=1)(self.values)


@pytest.mark.exhaustive
def test_motion_by_all_that_a_beam_is_made_of():
    """The tip's place by stiffness, length, density, load history and unstressed curvature:

    the scene itself is built from numbers that are differentiated.
    """
    values = jnp.array([[0.0, 0.0, 0.0], [0.5, 2.0, -1.0], [-1.0, 0.5, 1.0]])

    def place(p):
        stiff, bulk = p["stiffness"], p["density"]
        numbers = {"EA": 300.0 * stiff, "GA": 200.0, "EI": (stiff, 2.0 * stiff), "GJ": 1.5}
        section = nc.Section.of_numbers(**numbers, density=bulk, rotary=0.02 * bulk)

        def arc(s):
            # A circle through the clamp along x, of any curvature and none.
            turn = p["curvature"] * s
            aside = 0.5 * turn * jnp.sinc(turn / (2 * jnp.pi)) ** 2
            return s * jnp.array([jnp.sinc(turn / jnp.pi), aside, 0.0])

        scene, more = nc.Scene(), {"length": p["length"], "elements": 4, "damping": 0.01}
        beam = scene.add(nc.Beam(section, arc, start=nc.ground, name="beam", **more))
        load = History(jnp.array([0.0, 0.1, 0.2]), p["load"])
        scene.add(nc.PointForce((nc.Point(beam.end, arc(p["length"])),), force=load))
        system, state = scene.compile()
        trajectory = nc.simulate(system, state, dt=0.01, steps=20)
        return system.sense(trajectory, beam.end).position[-1]

    place = jax.jit(place)
    p = {"stiffness": 1.0, "density": 1.0, "length": 1.0, "curvature": 0.4}
    p = jax.tree.map(jnp.asarray, p) | {"load": values}
    weights = jnp.array([0.3, -0.7, 0.6])
    gradient = jax.jit(jax.grad(lambda p: weights @ place(p)))(p)
    forward = jax.jit(lambda p, d: jax.jvp(place, (p,), (d,))[1])
    steps = 10.0 ** -np.arange(1.5, 8.5, 0.5)
    for name in p:
        direction = jax.tree.map(jnp.zeros_like, p) | {name: jnp.ones_like(p[name])}
        slope = forward(p, direction)
        named(name, place, p, direction, slope, steps=steps)
        assert np.isclose(jnp.sum(gradient[name]), weights @ slope, rtol=tol.SAME_GRADIENT), name


@pytest.mark.exhaustive
@pytest.mark.parametrize(("element", "number"), [("Hexahedron27P1", "E"), ("Tetrahedron10", "reference")])
def test_motion_by_the_numbers_of_a_solid(element, number):
    """Of where a corner is after some steps, by a modulus and by the shape without stress."""
    mesh = nc.mesh.box((1.0, 0.5, 0.5), (1, 1, 1), element=ELEMENTS[element])
    scene, rubber = nc.Scene(), nc.NeoHooke(E=1e4, nu=0.4, density=DENSITY)
    part = scene.add(nc.Solid(mesh, material=rubber, element=element))
    scene.add(nc.Clamp(nc.ground, part.set("x0")))
    scene.add(nc.Gravity())
    system, state = scene.compile()
    tip, value = part.nearest((1.0, 0.5, 0.5)), system.get(part, number)

    @jax.jit
    def last(factor):
        changed = system.set(part, **{number: factor * value})
        return changed.sense(nc.simulate(changed, state, dt=5e-3, steps=10), tip).position[-1, 2]

    one = jnp.asarray(1.0)
    assert_v_shaped(last, one, one, jax.grad(last)(one))


@pytest.mark.exhaustive
def test_motion_by_the_speed_of_directors():
    """A net of directors on threads: reverse and forward are the same, and what differences show."""
    places = np.array([(0.0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0)])
    scene, turning = nc.Scene(), {"inertia": 2.5e-4, "angular_velocity": (0.3, 0.2, 1.0)}
    scene.add(nc.Gravity())
    mesh = scene.add(nc.Nodes.directors(places, (0, 0, 1), mass=0.25, name="net", **turning))
    threads = [(0, 1), (2, 3), (0, 2), (1, 3)]
    scene.add(nc.QuadraticSpring.on(mesh, threads, stiffness=200.0, length=1.0, name="threads"))
    scene.add(nc.Rod((nc.Point(nc.ground, (0, 0, 1)), nc.Point(mesh[0])), name="rod"))
    system, state = scene.compile()
    moved = np.zeros(state.rows.shape)
    moved[:, 0] = np.random.default_rng(0).normal(size=(4, 3))
    moved = jnp.asarray(moved.reshape(-1, 3))

    def loss(speed):
        start = eqx.tree_at(lambda s: s.v, state, state.v + speed * moved)
        return jnp.sum(nc.simulate(system, start, dt=0.02, steps=10).q[-1] ** 2)

    at = jnp.asarray(0.3)
    slope = jax.jit(jax.grad(loss))(at)
    assert_v_shaped(jax.jit(loss), at, jnp.ones(()), slope)
    np.testing.assert_allclose(jax.jvp(loss, (at,), (jnp.ones(()),))[1], slope, rtol=tol.SAME_GRADIENT)


# --- statics ------------------------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_equilibria_by_the_numbers_of_a_beam():
    """Stiffness, length, load and unstressed curvature of a beam that is bent by a radian: forward, reverse,

    second.
    """
    system, state, beam = rod(force=(0.5, 2.0, 1.0))
    elements = list(beam.elements)
    reference = system.get(elements, "reference")

    def place(p):
        changed = scaled(system, beam, stiffness=p[0], length=p[1])
        bent = reference + p[3] * jnp.array([0, 0, 0, 1.0, 0.5, 0])
        changed = changed.set(elements, reference=bent)
        end = nc.equilibrium(changed, state, p[2] * jnp.array([0.5, 1.0])).state
        return changed.sense(end, beam.end).position[1]

    p, place, units = jnp.array([1.0, 1.0, 1.0, 0.1]), jax.jit(place), jnp.eye(4)
    # One program for both: the derivative of the gradient comes with the gradient.
    graded = jax.jit(lambda p: jax.jvp(jax.grad(place), (p,), (units[2],)))
    gradient, curvature = graded(p)
    for k, name in enumerate(("stiffness", "length", "load", "curvature")):
        named(name, place, p, units[k], gradient[k])
    named("second", lambda p: graded(p)[0], p, units[2], curvature)
    forward = jax.jvp(place, (p,), (units[1],))[1]
    assert np.isclose(forward, gradient[1], rtol=tol.SAME_GRADIENT)


@pytest.mark.exhaustive
def test_sag_by_density():
    """Could go wrong: weight that is no function of the section. Small sag is in proportion to density, and

    a large one has the derivative that differences show: the scene is made of the number it is derived by.
    """

    def sag(density, gravity):
        section = nc.Section.of_numbers(**NUMBERS | {"density": density})
        system, state, beam = rod(section, gravity=(0.0, 0.0, -gravity))
        return system.sense(nc.equilibrium(system, state, jnp.array([0.5, 1.0])).state, beam.end).position[2]

    graded = jax.jit(jax.value_and_grad(sag))
    density, small, large = jnp.asarray(2.0), jnp.asarray(1e-4), jnp.asarray(4.0)
    value, slope = (float(x) for x in graded(density, small))
    # Four uneven elements: a few per cent off the textbook.
    assert value == pytest.approx(-2e-4 * (1 / (8 * NUMBERS["EI"][0]) + 0.5 / NUMBERS["GA"][1]), rel=0.05)
    assert slope == pytest.approx(value / 2.0, rel=tol.FIRST_ORDER)
    value, slope = graded(density, large)
    assert value < -0.4
    assert_v_shaped(lambda x: graded(x, large)[0], density, jnp.ones(()), slope)


@pytest.mark.exhaustive
def test_derivatives_of_a_path():
    """Could go wrong: a rate along the path in place of the derivative at fixed load, which is promised."""
    system, state, arch, top = shallow_arch(4)

    def path(p):
        stiffer = scaled(system, arch, stiffness=p)
        return nc.load_path(stiffer, state, arc=0.05, steps=4, scale=1e3).states

    one = jnp.ones(())
    states, rates = jax.jvp(path, (one,), (one,))
    loads, row = np.asarray(states.t), 4 * system.body_index(top)
    # Before the limit point and beyond it, where the load has halved again.
    assert np.argmax(loads) == 1 and loads[0] < 0.8 * loads[1] and loads[3] < 0.6 * loads[1]
    h = 1e-4
    for k in (0, 3):
        begin = jax.tree.map(lambda x, k=k: x[k], states)
        near = [
            nc.equilibrium(scaled(system, arch, stiffness=one + s * h), begin, loads[k : k + 1]).state.q
            for s in (1, -1)
        ]
        difference = (near[0] - near[1]) / (2 * h)
        assert float(jnp.abs(difference[row, 2])) > 1e-3
        scale = float(jnp.max(jnp.abs(difference)))
        np.testing.assert_allclose(rates.q[k], difference, rtol=0, atol=1e-6 * scale)
    np.testing.assert_array_equal(rates.t, 0.0)


FACTORS = ("E", "thickness", "density", "prestress", "shape along x", "shape across", "load")
"""The last: of a force that varies over the loads, or the steps, one number of them after the other."""


@pytest.fixture(scope="module")
def plate():
    """A warped plate, held along an edge, under its weight and a force on a corner."""
    mesh = nc.mesh.rectangle((1.0, 0.5), (3, 2))
    bent = mesh.nodes + 0.05 * np.stack([0 * mesh.nodes[:, 0]] * 2 + [np.sin(3 * mesh.nodes[:, 0])], axis=1)
    scene, metal = nc.Scene(), nc.Elastic(E=2e5, nu=0.3, density=1200.0)
    more = {"thickness": 0.1, "material": metal, "prestress": (300.0, 200.0, 50.0), "name": "plate"}
    shell = scene.add(nc.Shell(nc.mesh.Mesh(bent, mesh.cells, mesh.sets), **more))
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    scene.add(nc.Gravity())
    corner = shell.set("right")[2]
    scene.add(nc.BodyForceInput((nc.Point(corner), nc.Direction(nc.ground, (0, 0, 1))), name="push"))
    return *scene.compile(), corner


def changed_plate(system, factors):
    """The system with numbers times the factors."""
    numbers = {key: system.get("plate", key) for key in (*FACTORS[:4], "reference")}
    scaled_numbers = {key: factors[k] * numbers[key] for k, key in enumerate(FACTORS[:4])}
    stretch = jnp.concatenate([jnp.stack([factors[4], factors[5]]), jnp.ones(1)])
    return system.set("plate", reference=stretch * numbers["reference"], **scaled_numbers)


def observed(system, state, corner):
    """Height of the corner, and energy, of order one."""
    height = system.sense(state, corner).position[2]
    return jnp.stack([10 * height, system.energy(state).stores["plate"]])


def in_statics(plate, factors):
    """Of the equilibrium under the last of three loads."""
    system, state, corner = plate
    softer = changed_plate(system, factors)
    force = (1 + jnp.arange(3.0) * factors[6])[:, None]
    end = nc.equilibrium(softer, state, jnp.arange(3.0), inputs=force, throw=False).state
    return observed(softer, end, corner)


def in_dynamics(plate, factors):
    """After eight steps under a force that grows."""
    system, state, corner = plate
    softer = changed_plate(system, factors)
    force = (20 + jnp.arange(8.0) * factors[6])[:, None]
    run = nc.simulate(softer, state, dt=5e-3, inputs=force)
    return observed(softer, jax.tree.map(lambda x: x[-1], run.states), corner)


def in_frequency(plate, factors):
    """Of the first vibrations about the equilibrium."""
    system, state, _ = plate
    softer, load = changed_plate(system, factors), factors[6] * jnp.ones((1, 1))
    still = nc.equilibrium(softer, state, jnp.ones(1), inputs=load, throw=False).state
    return nc.modes(softer, still, inputs=load[0], damped=False).frequencies[:2]


@pytest.mark.exhaustive
@pytest.mark.parametrize("of", [in_statics, in_dynamics, in_frequency])
def test_all_numbers_of_a_warped_plate(plate, of):
    """Each on its own, of both values."""
    value = jax.jit(lambda factors: of(plate, factors))
    ones, units = jnp.ones(len(FACTORS)), jnp.eye(len(FACTORS))
    slopes = jax.jit(jax.jacrev(lambda factors: of(plate, factors)))(ones)
    for k, name in enumerate(FACTORS):
        for row in range(2):
            named(f"{name}, value {row}", lambda x, row=row: value(x)[row], ones, units[k], slopes[row, k])


@pytest.mark.exhaustive
def test_thickness_for_stiffness_at_a_given_mass():
    """A cantilever that is stiffest at its end has a thickness as the root of the bending moment."""
    count, scene, metal = 8, nc.Scene(), nc.Elastic(E=1.2e6, density=3.1314e-4)
    mesh = nc.mesh.rectangle((1.0, 1.0), (count, 1))
    shell = scene.add(nc.Shell(mesh, thickness=np.full(count, 0.02), material=metal, name="plate"))
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    for node in shell.set("right"):
        push(scene, node, (0, 0, 1e-4))
    system, state = scene.compile()
    tip = shell.set("right")[0]

    def sag(shape):
        thickness = 0.02 * count * jax.nn.softmax(shape)
        changed = system.set(shell, thickness=thickness)
        end = nc.equilibrium(changed, state, steps=1).state
        return jnp.log(changed.sense(end, tip).position[2])

    optimiser, value_and_slope = optax.adam(0.1), jax.jit(jax.value_and_grad(sag))
    shape = jnp.zeros(count)
    memory, values = optimiser.init(shape), []
    for _ in range(60):
        value, slope = value_and_slope(shape)
        change, memory = optimiser.update(slope, memory)
        shape, values = optax.apply_updates(shape, change), [*values, float(value)]
    assert np.exp(values[-1] - values[0]) == pytest.approx((2 / 3) ** 4 * 3, rel=0.03)
    moment = 1.0 - (np.arange(count) + 0.5) / count
    exact = np.sqrt(moment) / np.mean(np.sqrt(moment))
    np.testing.assert_allclose(count * jax.nn.softmax(shape)[:-1], exact[:-1], rtol=0.05)
