"""Conservation over very many steps, and the balances of stores, losses, drives, inputs and loads."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account, relative, rows

import natcoord_jax as nc
from natcoord_jax.gallery.spacecraft import BASE, WHEELS

STEPS, DT = 1000, 0.02
EXCHANGED = 0.2  # share of the energy that a store must exchange for its test to mean anything

# --- the free spacecraft, over very many steps -----------------------------------------------------------


def spinning_craft():
    """The spacecraft of the paper, motors idle, all parts spinning, the common centre of mass at rest."""
    spin, wheels = np.array([0.3, -0.2, 0.4]), (2.0, -3.0, 4.0)
    places = [distance * np.eye(3)[k] for k, (_, _, distance) in enumerate(WHEELS)]
    masses = [mass for mass, _, _ in WHEELS]
    centre = np.average(np.array([np.zeros(3), *places]), axis=0, weights=[BASE[0], *masses])
    drift = -np.cross(spin, centre)
    scene = nc.Scene()
    hub = nc.RigidBody(
        mass=BASE[0], second_moment=BASE[1], velocity=drift, angular_velocity=spin, name="base"
    )
    base = scene.add(hub)
    for k, (mass, moment, distance) in enumerate(WHEELS):
        axis = np.eye(3)[k]
        wheel = nc.RigidBody(
            mass=mass,
            second_moment=moment,
            position=distance * axis,
            velocity=drift + np.cross(spin, distance * axis),
            angular_velocity=spin + wheels[k] * axis,
            name=f"wheel {k + 1}",
        )
        scene.add(nc.Revolute(base, scene.add(wheel), point=distance * axis, axis=axis))
    return scene.compile()


@pytest.mark.parametrize("dt", [1e-1, 1e-3, 1e-6, 1e-9])
def test_free_spacecraft_over_20000_steps(dt):
    system, state = spinning_craft()
    found = account(system, nc.simulate(system, state, dt=dt, steps=20_000, save_every=40))
    assert found.energy_error <= tol.LONG_ENERGY
    assert found.directors <= tol.LONG_DIRECTORS
    assert found.joints <= tol.CONSTRAINT
    assert found.spin_error() <= tol.ANGULAR_MOMENTUM
    assert found.momentum_error() <= tol.MOMENTUM


# --- stores, losses and work on joint coordinates ---------------------------------------------------------


def rotor(*effects, inertia=0.5, gravity=0.0, com=(0.0, 0.0, 0.0), rate=0.0, joint=nc.Revolute):
    """A body on the ground with one joint, its axis skew, through the origin; `effects` act on the joint."""
    axis = np.array([1.0, 2.0, 2.0]) / 3
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, 0.0, -gravity), name="gravity"))
    slides = joint is nc.Prismatic
    body = nc.RigidBody(
        mass=2.0,
        inertia=inertia * np.eye(3),
        com=com,
        velocity=rate * axis * slides,
        angular_velocity=rate * axis * (not slides),
        name="body",
    )
    hinge = scene.add(joint(nc.ground, scene.add(body), point=(0.0, 0.0, 0.0), axis=axis, name="joint"))
    for effect in effects:
        scene.add(effect(hinge))
    return scene.compile()


def test_torsional_spring_over_five_turns():
    """A coil wound by five turns: its energy is that of the angle counted on, to round-off."""
    stiffness, rest = 0.3, 5 * 2 * np.pi
    system, state = rotor(lambda hinge: nc.JointSpring(hinge, stiffness=stiffness, rest=rest, name="coil"))
    trajectory = nc.simulate(system, state, dt=0.05, steps=STEPS)
    d = rows(trajectory.q)[:, 0, 1:]
    axis = np.array([1.0, 2.0, 2.0]) / 3
    across = d[0] - np.outer(d[0] @ axis, axis)
    angles = np.arctan2(np.einsum("tic,ic->t", d, np.cross(axis, across)), np.einsum("tic,ic->t", d, across))
    counted = np.unwrap(angles)
    assert np.ptp(counted) >= 9 * 2 * np.pi
    assert np.max(np.abs(np.asarray(trajectory.states.coordinates)[:, 0] - counted)) <= tol.CONSTRAINT
    found = account(system, trajectory)
    exact = 0.5 * stiffness * (counted - rest) ** 2
    assert np.max(np.abs(found.stores["coil"] - exact)) <= tol.ENERGY * np.max(exact)
    assert found.energy_error <= tol.ENERGY
    assert found.exchanged()["coil"] >= 0.99


@pytest.mark.parametrize("joint", [nc.Revolute, nc.Prismatic])
def test_joint_damper_dissipates_exactly(joint):
    """In a step c (increment)^2 / h, no more and no less; all of the energy goes there."""
    damping, dt = 0.4, 0.05
    system, state = rotor(
        lambda hinge: nc.JointDamper(hinge, damping=damping, name="damper"), rate=4.0, joint=joint
    )
    trajectory = nc.simulate(system, state, dt=dt, steps=100)
    found = account(system, trajectory)
    turned = np.diff(np.asarray(trajectory.states.coordinates)[:, 0])
    lost = damping * turned**2 / dt
    assert np.max(np.abs(np.diff(found.kinetic) + lost)) <= tol.STEP_BALANCE * found.kinetic[0]
    assert np.max(np.abs(np.diff(found.works["damper"]) + lost)) <= tol.STEP_BALANCE * found.kinetic[0]
    assert found.kinetic[-1] < 0.2 * found.kinetic[0]


def test_damper_between_points_keeps_momenta():
    """It dissipates c (rate of the mid-point length)^2 h and does nothing to momenta."""
    damping, dt = 3.0, 0.05
    scene = nc.Scene()
    one = scene.add(nc.RigidBody(mass=1.0, inertia=(0.2, 0.3, 0.4), angular_velocity=(1.0, 2.0, -1.0)))
    far = nc.RigidBody(mass=2.0, inertia=(0.5, 0.4, 0.3), position=(1.0, 0.2, 0.0), velocity=(0.5, 1.0, 0.3))
    other = scene.add(far)
    ends = nc.Point(one, (0.3, 0.1, 0.0)), nc.Point(other, (0.8, 0.4, 0.1))
    scene.add(nc.Damper(ends, name="damper", damping=damping))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=dt, steps=200)
    found = account(system, trajectory)
    weights = np.asarray(system.effects[0].weights)[0]
    ends = np.einsum("ka,tkac->tkc", weights, rows(trajectory.q)[:, np.asarray(system.effects[0].bodies)[0]])
    line = ends[:, 1] - ends[:, 0]
    middle, step = 0.5 * (line[1:] + line[:-1]), np.diff(line, axis=0)
    stretched = np.einsum("tc,tc->t", middle, step) / np.linalg.norm(middle, axis=1)
    lost = damping * stretched**2 / dt
    assert np.sum(lost) >= 0.2 * found.kinetic[0]
    assert np.max(np.abs(np.diff(found.kinetic) + lost)) <= tol.STEP_BALANCE * found.kinetic[0]
    assert found.momentum_error() <= tol.MOMENTUM
    assert found.spin_error() <= tol.ANGULAR_MOMENTUM


@pytest.mark.parametrize("joint", [nc.Revolute, nc.Prismatic])
def test_drive_balances_its_work(joint):
    """The drive obeys its function at the ends of the steps, and its work is the change of energy."""

    def function(t):
        return 1.5 * jnp.sin(2.0 * t) + 0.5 * t**2

    system, state = rotor(
        lambda hinge: nc.Drive(hinge, function=function, name="drive"),
        gravity=9.81,
        com=(0.3, 0.1, -0.2),
        rate=3.0,
        joint=joint,
    )
    trajectory = nc.simulate(system, state, dt=0.05, steps=100)
    found = account(system, trajectory)
    wanted = np.asarray(function(trajectory.t))
    gap = np.abs(trajectory.states.coordinates[:, 0] - wanted)
    assert np.max(gap) <= tol.CONSTRAINT * np.max(np.abs(wanted))
    assert found.energy_error <= tol.ENERGY
    assert np.ptp(found.works["drive"]) >= EXCHANGED * found.energy_scale


def test_armature_adds_to_the_inertia():
    """A constant torque on rotor and body: the rate grows by u t / (J + I); the work is exact at any step."""
    inertia, armature, torque = 0.5, 1.3, 2.0
    system, state = rotor(
        lambda hinge: nc.Armature(hinge, inertia=armature, name="armature"),
        lambda hinge: nc.JointForce(hinge, name="motor"),
        inertia=inertia,
    )
    errors = []
    for dt in (0.05, 0.025):
        trajectory = nc.simulate(system, state, dt=dt, steps=round(3.0 / dt), inputs=jnp.array([torque]))
        found = account(system, trajectory)
        turned = np.asarray(trajectory.states.coordinates)[:, 0]
        assert found.energy_error <= tol.ENERGY
        assert np.allclose(found.works["motor"], torque * turned, rtol=1e-12, atol=1e-13)
        errors.append(turned[-1] - 0.5 * torque * 3.0**2 / (inertia + armature))
    assert turned[-1] >= 1.0
    assert abs(errors[1]) <= 1e-2
    assert np.log2(errors[0] / errors[1]) == pytest.approx(tol.ORDER, abs=tol.ORDER_TOLERANCE)


def test_armature_under_gravity_keeps_energy():
    system, state = rotor(
        lambda hinge: nc.Armature(hinge, inertia=0.2, name="armature"), gravity=9.81, com=(0.4, 0.0, 0.3)
    )
    found = account(system, nc.simulate(system, state, dt=DT, steps=STEPS))
    assert min(found.exchanged().values()) >= 0.1
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY


def test_stops_return_the_energy():
    """A pendulum that strikes stiff stops; the energy has a kink there and is kept all the same."""
    system, state = rotor(
        lambda hinge: nc.JointStops(hinge, stiffness=400.0, lower=-0.2, upper=0.9, name="stops"),
        gravity=9.81,
        com=(0.4, 0.0, 0.3),
        rate=2.0,
    )
    trajectory = nc.simulate(system, state, dt=DT, steps=STEPS)
    found = account(system, trajectory)
    struck = np.diff((found.stores["stops"] > 0).astype(int)) > 0
    assert np.sum(struck) >= 10
    assert found.exchanged()["stops"] >= EXCHANGED
    assert found.energy_error <= tol.ENERGY


def test_gear_keeps_energy_and_relation():
    """Two rotors geared 1 : -3, one with a coil."""
    scene = nc.Scene()
    hinges = []
    for k in range(2):
        body = scene.add(nc.RigidBody(mass=1.0, inertia=(0.3, 0.3, 0.2), position=(1.0 * k, 0.0, 0.0)))
        hinges.append(scene.add(nc.Revolute(nc.ground, body, axis=(0.0, 0.0, 1.0))))
    scene.add(nc.JointSpring(hinges[0], stiffness=1.0, rest=4.0, name="coil"))
    scene.add(nc.Coupling(tuple(hinges), factors=(3.0, 1.0), coordinate=(0, 0), name="gear"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.1, steps=STEPS)
    found = account(system, trajectory)
    turned = np.asarray(trajectory.states.coordinates)
    assert np.max(np.abs(turned @ [3.0, 1.0])) <= tol.CONSTRAINT * np.max(np.abs(turned))
    assert found.exchanged()["coil"] >= EXCHANGED
    assert found.energy_error <= tol.ENERGY
    # one degree of freedom with the inertia J + 9 J: a harmonic motion of known frequency
    assert np.max(turned[:, 0]) == pytest.approx(8.0, rel=1e-3)


# --- work of inputs and loads -----------------------------------------------------------------------------


def _wave(t):
    return jnp.stack([0.2 * jnp.cos(t), jnp.sin(t), jnp.zeros_like(t)])


def loaded():
    """A free pair with everything that works on it."""
    scene = nc.Scene()
    one = scene.add(nc.RigidBody(mass=1.0, inertia=(0.2, 0.3, 0.4), com=(0.1, 0.0, 0.05), name="one"))
    two = scene.add(nc.RigidBody(mass=2.0, inertia=(0.5, 0.4, 0.3), position=(1.0, 0.2, 0.0), name="two"))
    hinge = scene.add(nc.Cylindrical(one, two, point=(0.5, 0.1, 0.0), axis=(1.0, 0.0, 1.0)))
    triad = tuple(nc.Direction(one, axis) for axis in np.eye(3))
    point = nc.Point(two, (1.3, 0.0, 0.2))
    scene.add(nc.JointTorque(hinge, name="torque"))
    scene.add(nc.JointForce(hinge, coordinate=0, name="turner"))
    scene.add(nc.JointForce(hinge, coordinate=1, name="pusher"))
    scene.add(nc.BodyTorqueInput(triad, name="wheels"))
    scene.add(nc.BodyForceInput((point, nc.Direction(two, (0.0, 1.0, 0.0))), name="thruster"))
    scene.add(nc.PointForce((point,), name="dead", force=(0.3, -0.2, 0.5)))
    scene.add(nc.PointForce((point, *triad), name="follower", force=_wave, following=True))
    scene.add(nc.BodyTorque(triad[:1], name="twist", torque=(0.1, 0.4, -0.2)))
    scene.add(nc.BodyTorque(triad, name="following twist", torque=(0.1, 0.1, 0.3), following=True))
    scene.add(nc.PairTorque((triad[2], nc.Direction(two, (0.0, 0.0, 1.0))), name="pair", torque=0.3))
    return scene.compile()


def test_work_accounts():
    """Each entry is force times displacement, and together they are the change of energy."""
    system, state = loaded()
    t = (np.arange(200) + 0.5) * 0.03
    waves = np.sin(np.outer(t, 1.0 + 0.3 * np.arange(len(system.structure.inputs))))
    trajectory = nc.simulate(system, state, dt=0.03, inputs=jnp.asarray(waves))
    found = account(system, trajectory)
    assert len(found.works) == 10
    assert min(np.ptp(w) for w in found.works.values()) >= 1e-3 * found.energy_scale
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY
    turned = np.diff(np.asarray(trajectory.states.coordinates), axis=0)
    for number, name in enumerate(("turner", "pusher")):
        inputs = np.asarray(trajectory.inputs)[:, system.input_index(name)]
        work = inputs * turned[:, number]
        assert np.max(np.abs(np.diff(found.works[name]) - work)) <= tol.STEP_BALANCE * found.energy_scale
    point = np.asarray(next(g for g in system.effects if "dead" in g.names).weights)[0, 0]
    where = np.einsum("a,tac->tc", point, rows(trajectory.q)[:, system.body_index("two")])
    work = (where - where[0]) @ [0.3, -0.2, 0.5]
    assert np.max(np.abs(found.works["dead"] - work)) <= tol.STEP_BALANCE * found.energy_scale * 200


def test_internal_inputs_keep_momenta():
    """Motors act with their opposites: no impulse, no angular impulse, whatever the step."""
    scene = nc.Scene()
    one = scene.add(nc.RigidBody(mass=1.0, inertia=(0.2, 0.3, 0.4), com=(0.1, 0.0, 0.05), name="one"))
    two = scene.add(nc.RigidBody(mass=2.0, inertia=(0.5, 0.4, 0.3), position=(1.0, 0.2, 0.0), name="two"))
    hinge = scene.add(nc.Cylindrical(one, two, point=(0.5, 0.1, 0.0), axis=(1.0, 0.0, 1.0)))
    scene.add(nc.JointTorque(hinge, name="torque"))
    scene.add(nc.JointForce(hinge, coordinate=0, name="turner"))
    scene.add(nc.JointForce(hinge, coordinate=1, name="pusher"))
    markers = nc.Direction(one, (0.0, 0.0, 1.0)), nc.Direction(two, (0.0, 0.0, 1.0))
    scene.add(nc.PairTorque(markers, name="pair", torque=0.1))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.05, steps=100, inputs=jnp.array([0.3, 0.2, 0.5]))
    found = account(system, trajectory)
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY
    assert found.momentum_error() <= tol.MOMENTUM
    impulse = 100 * 0.05 * (0.3 + 0.2 + 0.1)
    assert found.spin_error(impulse=impulse) <= tol.ANGULAR_MOMENTUM


def test_impulse_of_torques_is_the_change_of_angular_momentum():
    """h m enters the balance whatever the step: one body, torque inputs along its own axes (61)."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(0.2, 0.3, 0.4), angular_velocity=(1.0, -2.0, 0.5)))
    scene.add(nc.BodyTorqueInput(tuple(nc.Direction(body, axis) for axis in np.eye(3)), name="wheels"))
    system, state = scene.compile()
    dt = 0.1
    inputs = np.random.default_rng(0).normal(size=(100, 3))
    trajectory = nc.simulate(system, state, dt=dt, inputs=jnp.asarray(inputs))
    found = account(system, trajectory)
    d = rows(trajectory.q)[:, 0, 1:]
    middle = 0.5 * (d[1:] + d[:-1])
    impulses = dt * np.einsum("ti,tic->tc", inputs, middle)
    change = np.diff(found.spins.sum(1), axis=0)
    scale = np.max(np.linalg.norm(found.spins.sum(1), axis=1)) + np.sum(np.abs(inputs)) * dt
    assert relative(np.max(np.abs(change - impulses)), scale) <= tol.STEP_BALANCE


def test_a_batch_has_the_balances_of_its_lanes():
    scene = nc.Scene()
    scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), angular_velocity=(0, 1, 0.1)))
    system, state = scene.compile()
    runs = jax.vmap(lambda dt: nc.simulate(system, state, dt=dt, steps=3))(jnp.array([0.1, 0.2]))
    found = nc.balance(system, runs)
    assert found.energy.shape == found.momentum.shape == (2, 4) and found.axes == 3
    for k in range(2):
        np.testing.assert_array_equal(found.angular_momentum[k], nc.balance(system, runs[k]).angular_momentum)


@pytest.mark.parametrize("weight", [0.0, 9.81])
def test_momenta_are_judged_where_not_every_step_is_there(weight):
    """Where only internal forces act: their resultants are rounding. Impulses of others are not known."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -weight)))
    one = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.2), angular_velocity=(1, 0, 2)))
    other = scene.add(nc.RigidBody(mass=2.0, inertia=(0.1, 0.2, 0.2), position=(1, 0, 0), velocity=(0, 1, 0)))
    scene.add(nc.Spring((nc.Point(one, (0.1, 0.2, 0)), nc.Point(other)), stiffness=50.0))
    system, state = scene.compile()
    found = nc.balance(system, nc.simulate(system, state, dt=DT, steps=100, save_every=5))
    assert found.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    if weight:
        assert found.momentum is None and "made in parts or not saved" in found.note
    else:
        assert found.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE and found.directions == 3
        assert found.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE and found.axes == 3
