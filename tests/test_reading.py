"""Velocities as they are read: tangent, the nearest in the metric of the mass, and free of alternation.

Could go wrong: a projection in another metric, or of bodies but not of rotors; drives and redundant loops
left out; controllers, terminal events or derivatives that see other velocities than sensors do; states that
a step goes on from, changed.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import alternation
from scenes import pair

import natcoord_jax as nc
from natcoord_jax import gallery

AXES = [(0, 0, 1), (0, 1, 0), (0, 1, 0), (0, 0, 1), (0, 1, 0), (0, 0, 1)]
LENGTHS, MASSES = (0.3, 0.4, 0.35, 0.2, 0.15, 0.1), (5, 4, 3, 1.5, 1, 0.5)
TARGET = np.array([0.5, 0.6, -0.8, 0.3, 0.7, 0.2])
STIFFNESS = np.array([5.0, 200, 100, 0.5, 3, 0.1])
DAMPING = np.array([0.3, 20, 10, 0.05, 0.3, 0.01])
ROTOR = 0.7


def arm():
    """Six slender links upon each other, a motor in every hinge."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    z, parent, hinges = 0.0, nc.ground, []
    for k, (length, mass) in enumerate(zip(LENGTHS, MASSES)):
        radius = 0.05 - 0.005 * k
        link = nc.RigidBody(
            shape=nc.Cylinder(radius, length),
            density=mass / (np.pi * radius**2 * length),
            position=(0, 0, z + length / 2),
            name=f"link {k + 1}",
        )
        link = scene.add(link)
        hinges.append(scene.add(nc.Revolute(parent, link, point=(0, 0, z), axis=AXES[k], name=f"hinge {k}")))
        scene.add(nc.JointTorque(hinges[-1], name=f"motor {k + 1}"))
        z, parent = z + length, link
    return *scene.compile(), hinges


@pytest.mark.slow
def test_rates_of_a_controlled_arm_do_not_alternate():
    """What a controller answers to would be its own noise: 3.6 of 22 rad/s at the longest step, otherwise."""
    system, state, hinges = arm()

    def rates(state):
        return jnp.stack([system.rate(state, hinge) for hinge in hinges])

    def controller(t, state):
        return STIFFNESS * (TARGET - state.coordinates) - DAMPING * rates(state)

    for dt in (0.01, 0.005, 0.0025):
        trajectory = nc.simulate(system, state, dt=dt, steps=200, inputs=controller)
        sensed = np.stack([np.asarray(system.rate(trajectory, hinge)) for hinge in hinges], axis=1)
        assert alternation(sensed[-40:], order=2) <= tol.ALTERNATION
        assert float(system.constraint_errors(trajectory).velocity.max()) <= tol.TANGENT_OF_A_SMALL_SCENE
        seen = jax.vmap(rates)(trajectory.states)
        np.testing.assert_allclose(sensed, seen, atol=tol.TANGENT_OF_A_SMALL_SCENE)
        wanted = jax.vmap(controller)(trajectory.t, trajectory.states)[:-1]
        np.testing.assert_allclose(trajectory.inputs, wanted, atol=tol.TANGENT)


def swinging(kind):
    """A link on the ground and one on it, with a rotor, a drive or a loop."""
    if kind == "loops":
        example = gallery.load("four_bar")
        return example.system, example.state
    scene = nc.Scene()
    scene.add(nc.Gravity())
    part: Any = {"inertia": (0.3, 0.4, 0.5), "com": (0.1, 0.0, -0.2)}
    one = scene.add(nc.RigidBody(mass=2.0, position=(0, 0, -0.5), name="one", **part))
    two = scene.add(nc.RigidBody(mass=1.0, position=(0.5, 0.2, -1.0), name="two", **part))
    first = scene.add(nc.Revolute(nc.ground, one, axis=(0, 1, 0.2), name="first"))
    second = scene.add(
        nc.Universal(one, two, point=(0.2, 0, -0.8), axis=(1, 0, 0), second=(0, 1, 0), name="second")
    )
    scene.add(nc.Armature(second, inertia=ROTOR, name="rotor"))
    if kind == "drive":
        scene.add(nc.Drive(first, function=lambda t: 0.8 * jnp.sin(2.0 * t), name="drive"))
    return scene.compile(assemble=True)


FREEDOMS = {"rotor": 3, "drive": 2, "loops": 1}
PUSHES = 8


def pushed(state):
    """The state with random velocities added, in lanes."""
    rng = np.random.default_rng(0)
    v, rates = (jnp.asarray(rng.normal(size=(PUSHES, *x.shape))) for x in (state.v, state.rates))
    return jax.vmap(
        lambda a, b: eqx.tree_at(lambda s: (s.v, s.rates), state, (state.v + a, state.rates + b))
    )(v, rates)


def weighted(system, states):
    """Velocities in lanes, in units in which squares are twice the kinetic energy, those of rotors, too."""
    squares, axes = np.linalg.eigh(np.asarray(system.mass))
    roots = axes * np.sqrt(np.maximum(squares, 0.0))[:, None, :]
    rates = np.einsum("bki,lbkc->lbic", roots, np.asarray(states.row_rates))
    rotors = np.sqrt(ROTOR) * np.asarray(states.rates)
    return np.concatenate([rates.reshape(len(rates), -1), rotors], axis=1)


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param("drive", marks=pytest.mark.slow),
        *(pytest.param(x, marks=pytest.mark.exhaustive) for x in ("rotor", "loops")),
    ],
)
def test_the_nearest_velocities_that_the_constraints_admit(kind):
    """All that are admitted, no more, and what is left out is across them in the metric of the mass."""
    system, state = swinging(kind)
    states = pushed(state)
    nearest = system.tangent(states)
    assert float(system.constraint_errors(nearest).velocity.max()) <= tol.TANGENT_OF_A_SMALL_SCENE
    before, after = weighted(system, states), weighted(system, nearest)
    admitted = after[1:] - after[0]
    sizes = np.linalg.svd(admitted, compute_uv=False)
    count = FREEDOMS[kind]
    assert sizes[count - 1] > 1e-3 > 1e-10 > np.max(sizes[count:], initial=0.0)
    np.testing.assert_allclose((before - after) @ admitted.T, 0.0, atol=tol.TANGENT)
    np.testing.assert_allclose(weighted(system, system.tangent(nearest)), after, atol=tol.TANGENT)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["drive", "loops"])
def test_trajectories_are_read_so(kind):
    """Energies are those of the states as they are."""
    system, state = swinging(kind)
    trajectory = nc.simulate(system, state, dt=0.02, steps=20)
    read = system.tangent(trajectory)
    assert float(system.constraint_errors(trajectory.states).velocity.max()) > tol.TANGENT
    assert float(system.constraint_errors(read).velocity.max()) <= tol.TANGENT_OF_A_SMALL_SCENE
    kinetic = np.asarray(system.energy(trajectory).kinetic)
    if kind == "drive":
        wanted = 1.6 * np.cos(2.0 * np.asarray(trajectory.t))
        np.testing.assert_allclose(system.rate(trajectory, "first"), wanted, atol=tol.TANGENT)
    else:
        assert np.all(np.asarray(system.energy(read).kinetic) <= kinetic * (1 + 1e-14))


@pytest.mark.exhaustive
def test_from_body_to_body_as_all_at_once():
    for joint in (nc.Universal, nc.Cylindrical, nc.Planar):
        velocities = []
        for solver in ("reduced", "recursive"):
            system, state = pair(joint, solver=solver)
            noise = np.random.default_rng(0).normal(size=(8, 3))
            read = system.tangent(eqx.tree_at(lambda s: s.v, state, state.v + noise))
            assert float(system.constraint_errors(read).velocity) <= tol.TANGENT_OF_A_SMALL_SCENE
            velocities.append(read.v)
        np.testing.assert_allclose(*velocities, atol=tol.TANGENT_OF_A_SMALL_SCENE)


@pytest.mark.exhaustive
def test_the_step_of_the_paper_as_it_stands():
    """The same states to the last digit, and readings of them as they are."""
    system, state = swinging("rotor")
    plain = nc.simulate(system, state, dt=0.02, steps=20)
    paper = nc.simulate(system, state, dt=0.02, steps=20, scheme=nc.EnergyMomentum(kick=False))
    np.testing.assert_array_equal(plain.v, paper.v)
    np.testing.assert_array_equal(system.tangent(paper).v, paper.v)
    assert float(system.constraint_errors(paper).velocity.max()) > tol.TANGENT
    errors = system.constraint_errors(plain.states).velocity
    np.testing.assert_array_equal(system.constraint_errors(paper).velocity, errors)


@pytest.mark.exhaustive
def test_whoever_is_given_a_state_is_given_tangent_velocities():
    """By `state.v`, too."""
    system, state = swinging("rotor")

    def until(state):
        return jnp.max(system.constraint_errors(state).velocity) - tol.TANGENT

    states = nc.simulate(system, state, dt=0.02, steps=5).states
    assert float(until(jax.tree.map(lambda x: x[-1], states))) > 0
    run = nc.simulate(system, state, dt=0.02, steps=5, until=until)
    assert int(run.steps_taken) == 5, "the event was given velocities across the constraints"


def pendulum():
    scene = nc.Scene()
    scene.add(nc.Gravity())
    part: Any = {"inertia": (0.3, 0.4, 0.5), "com": (0.1, 0.05, -0.4), "angular_velocity": (0, 2.0, 0.4)}
    arm = scene.add(nc.RigidBody(mass=2.0, name="arm", **part))
    hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 1, 0.2), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return *scene.compile(), hinge


@pytest.mark.exhaustive
def test_derivatives_through_a_controller_that_reads_rates():
    """By its gain, by the mass, which is in the projection, too, and by the start; both ways."""
    system, state, hinge = pendulum()
    rng = np.random.default_rng(0)
    across = jnp.asarray(0.1 * rng.normal(size=state.v.shape))

    def last(x):
        shares = 1.0 + x[1] * jnp.diag(jnp.arange(4.0))
        heavier = eqx.tree_at(lambda s: s.mass, system, system.mass * shares)
        pushed = eqx.tree_at(lambda s: s.v, state, state.v + x[2] * across)

        def controller(t, state):
            read = heavier.tangent(state).v
            return -(x[0] * heavier.rate(state, hinge) + 0.1 * read[1, 2])[None]

        end = nc.simulate(heavier, pushed, dt=0.05, steps=20, inputs=controller)
        return heavier.rate(end, hinge)[-1] + end.states.coordinates[-1, 0]

    at, h = jnp.array([0.7, 0.01, 0.5]), 1e-3
    value = jax.jit(last)
    shifts = [[float(value(at.at[k].add(m * h))) for m in (-2, -1, 1, 2)] for k in range(3)]
    wanted = [(8 * (x[2] - x[1]) - (x[3] - x[0])) / (12 * h) for x in shifts]
    assert np.min(np.abs(wanted)) > 1e-3
    gradient = jax.jit(jax.grad(last))(at)
    np.testing.assert_allclose(gradient, wanted, rtol=tol.DIFFERENCE_BEST)
    along = jnp.array([0.3, -0.2, 0.5])
    tangent = jax.jit(lambda x: jax.jvp(last, (x,), (along,))[1])(at)
    scale = np.abs(gradient) @ np.abs(along)
    np.testing.assert_allclose(tangent, gradient @ along, atol=tol.SAME_GRADIENT * scale)


@pytest.mark.exhaustive
def test_lanes_of_a_batch_are_read_as_they_are_alone():
    system, state, hinge = pendulum()

    def run(dt):
        return nc.simulate(system, state, dt=dt, steps=20, inputs=lambda t, s: -system.rate(s, hinge)[None])

    lengths = jnp.array([0.02, 0.05])
    lanes = jax.vmap(run)(lengths)
    rates = jax.vmap(lambda trajectory: system.sense(trajectory, hinge).rates)(lanes)
    np.testing.assert_allclose(system.sense(lanes, hinge).rates, rates, atol=tol.TANGENT_OF_A_SMALL_SCENE)
    one = system.sense(run(lengths[1]), hinge)
    np.testing.assert_allclose(rates[1], one.rates, atol=tol.TANGENT_OF_A_SMALL_SCENE)
    # A sensor that comes out of a batch has a batch of systems.
    sensors, wanted = jax.vmap(lambda x: system.sense(x, "arm"))(lanes), system.sense(lanes, "arm")
    spins = sensors.angular_velocity, wanted.angular_velocity
    np.testing.assert_allclose(*spins, atol=tol.TANGENT_OF_A_SMALL_SCENE)
