"""What one reads from a state, and sets in it, against exact values and independent equations."""

import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc

ROUND_OFF = 1e-13
EQUATIONS = 1e-9  # accelerations and reactions relative to their size: one dense solve
AXIS = (0.3, -0.5, 0.8)
KINDS = {
    "revolute": nc.Revolute,
    "prismatic": nc.Prismatic,
    "cylindrical": nc.Cylindrical,
    "planar": nc.Planar,
    "universal": nc.Universal,
    "spherical": nc.Spherical,
    "fixed": nc.Fixed,
    "screw": nc.Screw,
}

TREE_KINDS = [kind for kind in KINDS if kind != "screw"]


def body(name, position, **more):
    return nc.RigidBody(
        mass=1.3, inertia=(0.2, 0.3, 0.4), com=(0.1, 0.05, -0.1), position=position, name=name, **more
    )


def chain(*kinds, backwards=False):
    """Bodies in a row: a ball joint, the joints asked for, a hinge; motors and springs on the way."""
    scene = nc.Scene()
    bodies = [scene.add(body("a", (0.5, 0.0, 0.0)))]
    scene.add(nc.Spherical(nc.ground, bodies[0], point=(0, 0, 0), name="ball"))
    for k, kind in enumerate(kinds):
        bodies.append(scene.add(body(f"b{k}", (1.0 + k, 0.4, 0.0), orientation=((1, 2, 3), 0.7 + k))))
        pair = bodies[-2:][::-1] if backwards else bodies[-2:]
        joint = scene.add(KINDS[kind](*pair, point=(0.8 + k, 0.2, 0.1), axis=AXIS, name=kind))
        for index in range(len(KINDS[kind].coordinates)):
            scene.add(nc.JointSpring(joint, stiffness=3.0, rest=0.2, coordinate=index))
    last = scene.add(body("c", (1.4 + k, 0.4, 0.3), orientation=((0, 1, 3), -0.4)))
    hinge = scene.add(nc.Revolute(bodies[-1], last, point=(1.2 + k, 0.4, 0.1), axis=(0, 1, 1), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    scene.add(nc.JointDamper(hinge, damping=0.3))
    scene.add(nc.Armature(hinge, inertia=0.2))
    ends = (nc.Point(nc.ground, (2, 2, 0)), nc.Point(last, (1.4 + k, 0.5, 0.3)))
    scene.add(nc.Spring(ends, stiffness=7.0, length=0.3))
    scene.add(nc.Gravity())
    return *scene.compile(), {handle.name: handle for handle in bodies}


def menagerie(loaded=True):
    """Every joint that describes its free motion, in both directions, each between two moving bodies.

    The joints are listed by name, with the bodies on both sides and their point.
    """
    scene, joints = nc.Scene(), []
    for k, (kind, backwards) in enumerate(itertools.product(TREE_KINDS, (False, True))):
        y = 3.0 * k
        a = scene.add(body(f"a{k}", (0.5, y, 0.0)))
        b = scene.add(body(f"b{k}", (1.0, y + 0.4, 0.0), orientation=((1, 2, 3), 0.7)))
        pair = (b, a) if backwards else (a, b)
        name = f"{kind} of pair {k}"
        joints += [(f"ball {k}", nc.ground, a, (0, y, 0)), (name, *pair, (0.8, y + 0.2, 0.1))]
        scene.add(nc.Spherical(nc.ground, a, point=joints[-2][3], name=f"ball {k}"))
        joint = scene.add(KINDS[kind](*pair, point=joints[-1][3], axis=AXIS, name=name))
        if loaded and KINDS[kind].coordinates:
            scene.add(nc.JointSpring(joint, stiffness=3.0, rest=0.2))
            scene.add(nc.JointForce(joint))
    scene.add(nc.Gravity())
    return *scene.compile(), joints


def loop():
    """A planar four-bar of hinges: 5 of its constraints say nothing new, 3 of them are redundant."""
    scene = nc.Scene()
    points = [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.5, 0.0, 1.2), (1.5, 0.0, 0.0)]
    bodies = [scene.add(body(f"bar {k}", points[k])) for k in range(3)]
    line = [nc.ground, *bodies, nc.ground]
    for k in range(4):
        scene.add(nc.Revolute(line[k], line[k + 1], point=points[k], axis=(0, 1, 0), name=f"hinge {k}"))
    scene.add(nc.Gravity())
    return *scene.compile(), [(f"hinge {k}", line[k], line[k + 1], points[k]) for k in range(4)]


def unbalanced(system, start, state, joints):
    """Largest force or torque that Newton's and Euler's laws miss for a body, by its mass and its joints."""
    rows = np.asarray(state.rows)
    pulled = (
        np.asarray(system.instant(state).accelerations).reshape(rows.shape)
        + np.array([0, 0, 9.81])[None, None] * np.eye(4)[0][None, :, None]
    )
    impulses = np.einsum("bij,bjc->bic", system.mass, pulled)
    force, torque = impulses[:, 0], np.cross(rows[:, 1:], impulses[:, 1:]).sum(axis=1)
    for name, parent, child, place in joints:
        sensor = system.sense(state, name)
        point = np.asarray(system.sense(state, nc.Point(child, place), state=start).position)
        for part, sign in ((parent, -1.0), (child, 1.0)):
            if part is not nc.ground:
                b = system.body_index(part.name)
                force[b] -= sign * np.asarray(sensor.force)
                torque[b] -= sign * (sensor.torque + np.cross(point - rows[b, 0], sensor.force))
    return np.max(np.abs([force, torque])) / (1 + np.max(np.abs(impulses)))


def close(a, b, tolerance):
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * (1 + float(np.max(np.abs(b)))))


def test_heavy_top_starts_with_the_published_acceleration():
    scene = nc.Scene()
    top = scene.add(
        nc.RigidBody(
            mass=15, inertia=(0.234375, 0.46875, 0.234375), com=(0, 1, 0), angular_velocity=(0, 150, -4.61538)
        )
    )
    scene.add(nc.Spherical(nc.ground, top, point=(0, 0, 0)))
    scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    system, state = scene.compile()
    com = system.sense(state, nc.Point(top, (0, 1, 0), local=True))
    np.testing.assert_allclose(com.acceleration, (0, -21.3017325444, -30.9608307692308), atol=1e-9)
    joint = system.sense(state, system.structure.joints[0])
    np.testing.assert_allclose(joint.force, 15 * (com.acceleration + jnp.array([0, 0, 9.81])), atol=1e-9)
    np.testing.assert_allclose(joint.torque, 0, atol=1e-9)


def pendulum():
    """R16 of the reference cases: hinge axis y, centre of mass 2 m from it along +x."""
    scene = nc.Scene()
    bar = scene.add(nc.RigidBody(mass=1, inertia=(0.04, 0.1, 0.1), position=(2, 0, 0), name="bar"))
    pin = scene.add(nc.Revolute(nc.ground, bar, point=(0, 0, 0), axis=(0, 1, 0), name="pin"))
    scene.add(nc.Gravity(vector=(0, 0, -9.80665)))
    return (*scene.compile(), bar, pin)


def test_hanging_chain_carries_its_weight():
    scene = nc.Scene()
    upper = scene.add(nc.RigidBody(mass=2.0, inertia=(0.1, 0.1, 0.1), position=(0.3, 0, 0)))
    lower = scene.add(nc.RigidBody(mass=3.0, inertia=(0.1, 0.1, 0.1), position=(0.5, 0, 0)))
    top = scene.add(nc.Fixed(nc.ground, upper, point=(0, 0, 0)))
    backwards = scene.add(nc.Fixed(lower, upper, point=(0.3, 0, 0)))
    scene.add(nc.Gravity(vector=(0, 0, -10.0)))
    system, state = scene.compile()
    np.testing.assert_allclose(system.sense(state, top).force, (0, 0, 50), atol=1e-12)
    np.testing.assert_allclose(
        system.sense(state, top).torque, (0, -2 * 10 * 0.3 - 3 * 10 * 0.5, 0), atol=1e-12
    )
    np.testing.assert_allclose(system.sense(state, backwards).force, (0, 0, -30), atol=1e-12)
    np.testing.assert_allclose(system.sense(state, backwards).torque, (0, 3 * 10 * 0.2, 0), atol=1e-12)


@pytest.mark.slow
def test_reactions_balance_all_bodies():
    """Newton's and Euler's laws for every body, joints of all kinds in both directions."""
    system, start, joints = menagerie(loaded=False)
    state = nc.random_state(system, start, jax.random.key(3))
    assert unbalanced(system, start, state, joints) <= EQUATIONS


@pytest.mark.exhaustive
def test_rates_and_accelerations_are_the_limits_of_short_steps():
    """What changes in a step, over its length: of velocities, and of coordinates, with motors and springs."""
    system, start, _ = menagerie()
    state = nc.random_state(system, start, jax.random.key(3))
    u = jnp.linspace(-1.0, 1.0, len(system.structure.inputs))

    @jax.jit
    @jax.vmap
    def quotients(h):
        after = nc.step(system, state, u, h)
        return (after.v - state.v) / h, (after.coordinates - state.coordinates) / h

    accelerations, rates = ((8 * c - 6 * b + a) / 3 for a, b, c in quotients(1e-3 / 2 ** jnp.arange(3.0)))
    close(system.instant(state, u).accelerations, accelerations, 1e-6)
    wanted = [system.rate(state, joint, index=index) for joint, index in system.structure.coordinates]
    close(wanted, rates, 1e-6)


@pytest.mark.exhaustive
def test_door_on_two_hinges_shares_its_weight():
    scene = nc.Scene()
    door = scene.add(nc.RigidBody(mass=4.0, inertia=(1.0, 1.0, 0.5), position=(0.5, 0, 0), name="door"))
    hinges = [
        scene.add(nc.Revolute(nc.ground, door, point=(0, 0, z), axis=(0, 0, 1), name=f"hinge {z}"))
        for z in (-1, 1)
    ]
    scene.add(nc.Gravity(vector=(0, 0, -10.0)))
    system, state = scene.compile()
    low, high = (system.sense(state, hinge) for hinge in hinges)
    np.testing.assert_allclose(low.force[2], 20, atol=1e-6)
    np.testing.assert_allclose(high.force[2], 20, atol=1e-6)
    np.testing.assert_allclose(low.force[0], -high.force[0], atol=1e-6)
    np.testing.assert_allclose(low.force + high.force, (0, 0, 40), atol=1e-9)


@pytest.mark.exhaustive
def test_redundant_loop_has_finite_reactions():
    """Which balance its bars; and so have their gradients."""
    system, start, joints = loop()
    moved = nc.simulate(system, start, dt=0.01, steps=20).states
    state = nc.assemble(system, jax.tree.map(lambda x: x[-1], moved))
    assert unbalanced(system, start, state, joints) <= 1e-8
    assert np.max(np.abs(system.instant(state).forces)) < 200

    def force(q):
        return system.instant(eqx.tree_at(lambda s: s.q, state, q)).forces[-1, 2]

    assert jnp.all(jnp.isfinite(jax.grad(force)(state.q)))


@pytest.mark.exhaustive
def test_drive_needs_the_torque_of_its_acceleration():
    scene = nc.Scene()
    rotor = scene.add(nc.RigidBody(mass=1.0, inertia=(0.3, 0.3, 0.4)))
    hinge = scene.add(nc.Revolute(nc.ground, rotor, axis=(0, 0, 1)))
    scene.add(nc.Drive(hinge, function=lambda t: 3.0 * t**2, name="drive"))
    scene.add(nc.Armature(hinge, inertia=0.1))
    system, state = scene.compile()
    instant = system.instant(state)
    np.testing.assert_allclose(instant.multipliers["drive"], 6.0 * 0.5, atol=1e-9)
    np.testing.assert_allclose(system.sense(state, rotor).angular_acceleration, (0, 0, 6), atol=1e-9)
    np.testing.assert_allclose(instant.torques, 0, atol=1e-9)


@pytest.mark.exhaustive
def test_wheel_counts_its_turns():
    scene = nc.Scene()
    wheel = scene.add(
        nc.RigidBody(mass=1, inertia=(1, 1, 1), angular_velocity=(0, 0, 10 * math.pi), name="wheel")
    )
    axle = scene.add(nc.Revolute(nc.ground, wheel, axis=(0, 0, 1)))
    system, state = scene.compile()
    # The free wheel turns by 2 atan(h omega / 2) in each step.
    h = 2 * math.tan(math.pi / 100) / (10 * math.pi)
    trajectory = nc.simulate(system, state, dt=h, steps=500)
    sensor = system.sense(trajectory, axle)
    np.testing.assert_allclose(sensor.angle[-1], 10 * math.pi, atol=1e-11)
    np.testing.assert_allclose(sensor.angle_rate, 10 * math.pi, atol=1e-11)
    quaternion = system.sense(trajectory, "wheel").quaternion
    assert jnp.max(jnp.abs(jnp.diff(quaternion, axis=0))) < 0.1
    np.testing.assert_allclose(quaternion[-1], (-1, 0, 0, 0), atol=1e-11)


SETTERS = [("revolute", True), ("planar", False), ("planar", True), ("universal", True), ("screw", False)]


def motion_between(system, start, one, other, parent, child):
    """Cosine of the angle by which the child has turned in its parent, and what the joint has moved there."""

    def seen(state):
        base, carried = system.sense(state, parent), system.sense(state, child)
        point = system.sense(state, nc.Point(child, (0.8, 0.2, 0.1)), state=start).position
        return base.rotation.T @ carried.rotation, base.rotation.T @ (point - base.position)

    (turn, place), (turned, moved) = seen(one), seen(other)
    return (jnp.trace(turned @ turn.T) - 1.0) / 2.0, jnp.linalg.norm(moved - place)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("kind", "backwards"), SETTERS)
def test_setters_move_one_coordinate_and_keep_all_else(kind, backwards):
    system, start, handles = chain(kind, backwards=backwards)
    pair = [handles[name] for name in (("b0", "a") if backwards else ("a", "b0"))]
    state = start if kind == "screw" else nc.random_state(system, start, jax.random.key(5))
    sensor = system.sense(state, kind)
    pitch = 0.01 / (2 * math.pi)
    for index in range(len(KINDS[kind].coordinates)):
        setter = jax.jit(lambda s, c, r, k=index: system.with_coordinate(s, kind, c, rate=r, index=k))
        moved = setter(state, 7.5, -1.2)
        errors = system.constraint_errors(moved)
        assert errors.position < ROUND_OFF and errors.velocity < 10 * ROUND_OFF
        after = system.sense(moved, kind)
        wanted, rates = sensor.coordinates.at[index].set(7.5), sensor.rates.at[index].set(-1.2)
        if kind == "screw":
            ratio = jnp.array([1.0, pitch]) if index == 0 else jnp.array([1 / pitch, 1.0])
            wanted, rates = 7.5 * ratio, -1.2 * ratio
        close(after.coordinates, wanted, ROUND_OFF)
        close(after.rates, rates, 10 * ROUND_OFF)
        # Bodies have turned by the angle and moved by the length that the coordinate says.
        change = wanted - sensor.coordinates
        cosine, length = motion_between(system, start, state, moved, *pair)
        if kind == "screw":
            expected = jnp.cos(change[0]), jnp.abs(change[1])
        elif KINDS[kind].coordinates[index].unit == "rad":
            expected = jnp.cos(change[index]), 0.0
        else:
            expected = 1.0, jnp.abs(change[index])
        close(jnp.stack([cosine, length]), jnp.stack(expected), 100 * ROUND_OFF)
        np.testing.assert_array_equal(system.sense(moved, "a").position, system.sense(state, "a").position)
        close(system.coordinate(moved, "hinge"), system.coordinate(state, "hinge"), ROUND_OFF)
        close(system.rate(moved, "hinge"), system.rate(state, "hinge"), 10 * ROUND_OFF)


@pytest.mark.exhaustive
def test_random_states_are_valid():
    system, state, _ = menagerie()
    keys = jax.random.split(jax.random.key(6), 5)
    states = jax.jit(jax.vmap(lambda key: nc.random_state(system, state, key)))(keys)
    errors = system.constraint_errors(states)
    assert jnp.max(errors.position) < ROUND_OFF and jnp.max(errors.velocity) < 10 * ROUND_OFF
    assert jnp.min(jnp.ptp(states.coordinates, axis=0)) > 0.1, "they are all the same"


def test_random_states_turn_rotors_along():
    system, state, _ = chain("universal")
    moving = nc.random_state(system, state, jax.random.key(6))
    np.testing.assert_allclose(moving.rates[0], system.rate(moving, "hinge"), atol=ROUND_OFF)


@pytest.mark.exhaustive
def test_reactions_differentiate_and_batch():
    system, state, bar, pin = pendulum()

    def force(rate, mass):
        changed = eqx.tree_at(lambda s: s.mass, system, mass * system.mass)
        moved = system.with_coordinate(state, pin, 0.4, rate=rate)
        return changed.sense(moved, pin).force[0]

    rates, masses = jnp.array([0.5, 1.5]), jnp.array([1.0, 2.0])
    gradients = jax.jit(jax.vmap(jax.grad(force, argnums=(0, 1))))(rates, masses)
    h = 1e-5
    for k in range(2):
        by_rate = (force(rates[k] + h, masses[k]) - force(rates[k] - h, masses[k])) / (2 * h)
        by_mass = (force(rates[k], masses[k] + h) - force(rates[k], masses[k] - h)) / (2 * h)
        np.testing.assert_allclose([g[k] for g in gradients], (by_rate, by_mass), rtol=1e-7)
    batch = jax.vmap(lambda rate: system.sense(system.with_coordinate(state, pin, 0.4, rate=rate), pin))(
        rates
    )
    np.testing.assert_allclose(batch.force[:, 0], [force(rate, 1.0) for rate in rates], rtol=1e-12)


@pytest.mark.exhaustive
def test_batches_of_trajectories_are_sensed_at_once():
    system, state, bar, pin = pendulum()
    steps = jnp.array([0.01, 0.02])
    batch = jax.jit(jax.vmap(lambda h: nc.simulate(system, state, dt=h, steps=4)))(steps)
    sensed = system.sense(batch, pin)
    assert sensed.angle.shape == (2, 5) and sensed.force.shape == (2, 5, 3)
    lane = jax.tree.map(lambda x: x[1], batch)
    close(sensed.force[1], system.sense(lane, pin).force, ROUND_OFF)
    body = system.sense(batch, bar)
    assert body.quaternion.shape == (2, 5, 4) and body.acceleration.shape == (2, 5, 3)


@pytest.mark.exhaustive
def test_rods_between_point_masses_know_their_length_and_pull():
    scene = nc.Scene()
    a = scene.add(nc.PointMass(mass=2.0, position=(1, 0, 0), velocity=(0, 0, 1.5)))
    b = scene.add(nc.PointMass(mass=3.0, position=(1, 0, -2), velocity=(0, 0, 1.5)))
    rods = [
        scene.add(nc.Distance(nc.ground, a, point=(1, 0, 0), parent_point=(0, 0, 0))),
        scene.add(nc.Distance(a, b, point=(1, 0, -2), parent_point=(1, 0, 0))),
    ]
    scene.add(nc.Gravity(vector=(0, 0, -10.0)))
    system, state = scene.compile()
    first, second = (system.sense(state, rod) for rod in rods)
    np.testing.assert_allclose([first.distance, second.distance], [1, 2], atol=ROUND_OFF)
    np.testing.assert_allclose(first.force, (-2 * 1.5**2, 0, 0), atol=EQUATIONS)
    np.testing.assert_allclose(second.force, 0, atol=EQUATIONS)


def test_rotors_start_with_the_rate_of_their_joint():
    scene = nc.Scene()
    wheel = scene.add(nc.RigidBody(mass=1, inertia=(1, 1, 1), angular_velocity=(0, 0, 3)))
    axle = scene.add(nc.Revolute(nc.ground, wheel, axis=(0, 0, 1)))
    scene.add(nc.Armature(axle, inertia=2.0, name="rotor"))
    system, state = scene.compile()
    np.testing.assert_allclose(system.energy(state).stores["rotor"], 9.0, atol=1e-12)


@pytest.mark.exhaustive
def test_markers_and_bodies_agree():
    system, state, handles = chain("universal")
    moved = nc.random_state(system, state, jax.random.key(8))
    sensed = system.sense(moved, "b0", inputs=jnp.array([0.3]))
    local = nc.Point(handles["b0"], (0.2, -0.1, 0.3), local=True)
    point = system.sense(moved, local, inputs=jnp.array([0.3]))
    arm = sensed.rotation @ jnp.array([0.2, -0.1, 0.3])
    spin, alpha = sensed.angular_velocity, sensed.angular_acceleration
    close(point.position, sensed.position + arm, ROUND_OFF)
    close(point.velocity, sensed.velocity + jnp.cross(spin, arm), ROUND_OFF)
    acceleration = sensed.acceleration + jnp.cross(alpha, arm) + jnp.cross(spin, jnp.cross(spin, arm))
    close(point.acceleration, acceleration, 1e-12)
    close(sensed.com, sensed.position + sensed.rotation @ jnp.array([0.1, 0.05, -0.1]), ROUND_OFF)
    world = nc.Point(local.body, system.sense(state, local).position)
    close(system.sense(moved, world, state=state).position, point.position, ROUND_OFF)
    with pytest.raises(ValueError, match="assembled pose"):
        system.sense(moved, world)
    still = system.sense(moved, nc.Point(nc.ground, (1, 2, 3)))
    np.testing.assert_array_equal(still.position, (1, 2, 3))
    np.testing.assert_array_equal(still.acceleration, 0)


def test_requests_that_cannot_be_met_say_why():
    system, state, _ = loop()
    closing = system.structure.joints[-1]
    with pytest.raises(ValueError, match="assemble"):
        system.with_coordinate(state, closing, 0.1)
    with pytest.raises(ValueError, match="loops"):
        nc.random_state(system, state, jax.random.key(0))
    with pytest.raises(ValueError, match="no number 1"):
        system.coordinate(state, closing, index=1)
    with pytest.raises(ValueError, match="cannot sense"):
        system.sense(state, "nobody")
    with pytest.raises(ValueError, match="0 coordinates in m"):
        _ = system.sense(state, closing).displacement
    with pytest.raises(ValueError, match="inputs has shape"):
        system.instant(state, jnp.zeros(2))


def test_a_body_that_is_welded_to_the_ground():
    """Nothing can move: its weight is the reaction, and the sensor prints what it has."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -10)))
    block = scene.add(nc.RigidBody(mass=2.0, inertia=(1, 1, 1), position=(0, 0, 1), name="block"))
    scene.add(nc.Fixed(nc.ground, block, name="weld"))
    system, state = scene.compile()
    weld = system.sense(state, "weld")
    np.testing.assert_allclose(weld.force, (0, 0, 20), rtol=0, atol=1e-12)
    np.testing.assert_allclose(system.tangent(state).v, 0.0, rtol=0, atol=0)
    assert "weld" in str(weld) and len(str(weld)) < 200
    assert len(str(system.sense(state, "block"))) < 200
