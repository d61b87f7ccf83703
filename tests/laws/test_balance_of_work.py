"""Balances of stores, losses, drives, inputs and loads: what works on a system is the change of its energy.

Rotors with an effect each stand side by side in one scene, whose program serves all of their tests; so does
that of a pair with everything that works on it, of which loads and inputs are numbers.
"""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account, relative, rows
from law_cases import DISSIPATIVE, ORDERS, VARIATIONAL, lane

import natcoord_jax as nc
from natcoord_jax.gallery.spacecraft import BASE, WHEELS

STEPS, DT, GRAVITY = 1000, 0.02, 9.81
EXCHANGED = 0.2  # share of the energy that a store must exchange for its test to mean anything

# --- stores, losses and work on joint coordinates ---------------------------------------------------------

AXIS = np.array([1.0, 2.0, 2.0]) / 3
LEVEL = np.array([0.6, -0.8, 0.0])
COIL, REST, DAMPING, ARMATURE, TORQUE, INERTIA = 0.3, 10 * np.pi, 0.4, 1.3, 2.0, 0.5
OFF = (0.4, 0.0, 0.3)


def swept(t):
    """What the drives ask for [rad, m]."""
    return 1.5 * jnp.sin(2.0 * t) + 0.5 * t**2


def drive(hinge, name):
    return nc.Drive(hinge, function=swept, name=name)


ROTORS = {
    "coil": ([lambda h, n: nc.JointSpring(h, stiffness=COIL, rest=REST, name=n)], {}),
    "damper": ([lambda h, n: nc.JointDamper(h, damping=DAMPING, name=n)], {"rate": 4.0}),
    "sliding damper": ([lambda h, n: nc.JointDamper(h, damping=DAMPING, name=n)], {"rate": 4.0}),
    "drive": ([drive], {"rate": 3.0, "com": (0.3, 0.1, -0.2)}),
    "sliding drive": ([drive], {"rate": 3.0, "com": (0.3, 0.1, -0.2)}),
    "motor": (
        [
            lambda h, n: nc.JointForce(h, name=n),
            lambda h, n: nc.Armature(h, inertia=ARMATURE, name=f"its {n}"),
        ],
        {},
    ),
    "armature": ([lambda h, n: nc.Armature(h, inertia=0.2, name=n)], {"com": OFF}),
    "stops": (
        [lambda h, n: nc.JointStops(h, stiffness=400.0, lower=-0.2, upper=0.9, name=n)],
        {"rate": 2.0, "com": OFF},
    ),
}
"""Effects by name, and the rate and the centre of mass of the body; axes pass through its reference point."""


@cache
def rotors():
    """Bodies on the ground with one joint each, of which those whose name says so slide."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, 0.0, -GRAVITY), name="gravity"))
    for k, (name, (effects, numbers)) in enumerate(ROTORS.items()):
        slides, rate = "sliding" in name, numbers.get("rate", 0.0)
        joint, axis = (nc.Prismatic, LEVEL if "damper" in name else AXIS) if slides else (nc.Revolute, AXIS)
        body = nc.RigidBody(
            mass=2.0,
            inertia=INERTIA * np.eye(3),
            com=numbers.get("com", (0.0, 0.0, 0.0)),
            position=(5.0 * k, 0.0, 0.0),
            velocity=rate * axis * slides,
            angular_velocity=rate * axis * (not slides),
            name=f"body {name}",
        )
        place = (5.0 * k, 0.0, 0.0)
        hinge = scene.add(joint(nc.ground, scene.add(body), point=place, axis=axis, name=f"joint {name}"))
        for effect in effects:
            scene.add(effect(hinge, name))
    return scene.compile()


class Rotor:
    """Coordinate, energies and works of one rotor, its kinetic and potential energy by NumPy."""

    def __init__(self, name, dt=DT, steps=STEPS):
        system, trajectory, result = turned(dt, steps)
        body = system.body_index(f"body {name}")
        mass = np.asarray(system.mass)[body]
        q, v = (rows(x)[:, body] for x in (trajectory.q, trajectory.v))
        self.t, self.directors = np.asarray(trajectory.t), q[:, 1:]
        self.coordinate = np.asarray(system.coordinate(trajectory, f"joint {name}"))
        self.kinetic = 0.5 * np.einsum("ab,tac,tbc->t", mass, v, v)
        self.stores = {k: x for k, x in result.stores.items() if name in (k, k.removeprefix("its "))}
        self.stores["weight"] = GRAVITY * np.einsum("a,ta->t", mass[0], q[..., 2])
        self.works = {k: x for k, x in result.works.items() if k == name}

    @property
    def scale(self):
        parts = [self.kinetic, *self.stores.values(), *self.works.values()]
        return float(np.max(np.sum(np.abs(parts), axis=0)))

    def check_energy(self):
        balance = self.kinetic + sum(self.stores.values()) - sum(self.works.values())
        assert np.max(np.abs(balance - balance[0])) <= tol.ENERGY * self.scale

    def exchanged(self, store):
        """Range of a store in terms of the energy that moves."""
        parts = {"kinetic": self.kinetic, **self.stores}
        above = sum(np.abs(values - np.min(values)) for values in parts.values())
        return float(np.ptp(parts[store]) / np.max(above))


@cache
def turned(dt, steps):
    system, state = rotors()
    room = nc.Steps(steps, STEPS)  # states after the last step repeat it
    trajectory = nc.simulate(system, state, dt=dt, steps=room, inputs=jnp.array([TORQUE]))
    return system, trajectory, account(system, trajectory)


@pytest.mark.slow
def test_torsional_spring_over_five_turns():
    """A coil wound by five turns: its energy is that of the angle counted on, to round-off."""
    result = Rotor("coil")
    d = result.directors
    across = d[0] - np.outer(d[0] @ AXIS, AXIS)
    angles = np.arctan2(np.einsum("tic,ic->t", d, np.cross(AXIS, across)), np.einsum("tic,ic->t", d, across))
    counted = np.unwrap(angles)
    assert np.ptp(counted) >= 9 * 2 * np.pi
    assert np.max(np.abs(result.coordinate - counted)) <= tol.CONSTRAINT
    exact = 0.5 * COIL * (counted - REST) ** 2
    assert np.max(np.abs(result.stores["coil"] - exact)) <= tol.ENERGY * np.max(exact)
    assert result.exchanged("coil") >= 0.99
    result.check_energy()


@pytest.mark.parametrize("name", [pytest.param("damper", marks=pytest.mark.slow), "sliding damper"])
def test_joint_damper_dissipates_exactly(name):
    """In a step c (increment)^2 / h, no more and no less; all of the energy goes there."""
    result = Rotor(name)
    lost = DAMPING * np.diff(result.coordinate) ** 2 / DT
    assert np.max(np.abs(np.diff(result.kinetic) + lost)) <= tol.STEP_BALANCE * result.kinetic[0]
    assert np.max(np.abs(np.diff(result.works[name]) + lost)) <= tol.STEP_BALANCE * result.kinetic[0]
    assert result.kinetic[-1] < 0.2 * result.kinetic[0]


@pytest.mark.parametrize("name", ["drive", "sliding drive"])
def test_drive_balances_its_work(name):
    """The drive obeys its function at the ends of the steps, and its work is the change of energy."""
    result = Rotor(name)
    wanted = np.asarray(swept(result.t))
    assert np.max(np.abs(result.coordinate - wanted)) <= tol.CONSTRAINT * np.max(np.abs(wanted))
    assert np.ptp(result.works[name]) >= EXCHANGED * result.scale
    result.check_energy()


def test_armature_adds_to_the_inertia():
    """A constant torque on rotor and body: the rate grows by u t / (J + I); the work is exact at any step."""
    errors = []
    for dt, steps in ((2 * DT, 300), (DT, STEPS)):
        result = Rotor("motor", dt, steps)
        result.check_energy()
        assert np.allclose(result.works["motor"], TORQUE * result.coordinate, rtol=1e-12, atol=1e-13)
        at = round(3.0 / dt)
        errors.append(result.coordinate[at] - 0.5 * TORQUE * 3.0**2 / (INERTIA + ARMATURE))
    assert result.coordinate[at] >= 1.0
    assert abs(errors[1]) <= 1e-2
    assert np.log2(errors[0] / errors[1]) == pytest.approx(tol.ORDER, abs=tol.ORDER_TOLERANCE)


def test_armature_under_gravity_keeps_energy():
    result = Rotor("armature")
    assert min(result.exchanged(name) for name in ("kinetic", "armature", "weight")) >= 0.1
    assert np.ptp(result.coordinate) >= 1.0
    result.check_energy()


def test_stops_return_the_energy():
    """A pendulum that strikes stiff stops; the energy has a kink there and is kept all the same."""
    result = Rotor("stops")
    struck = np.diff((result.stores["stops"] > 0).astype(int)) > 0
    assert np.sum(struck) >= 10
    assert result.exchanged("stops") >= EXCHANGED
    result.check_energy()


def test_rotors_balance_as_a_system():
    """With the accounts of the library, all of them."""
    assert turned(DT, STEPS)[2].energy_error <= tol.ENERGY


@pytest.mark.exhaustive
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
    result = account(system, trajectory)
    angles = np.asarray(trajectory.states.coordinates)
    assert np.max(np.abs(angles @ [3.0, 1.0])) <= tol.CONSTRAINT * np.max(np.abs(angles))
    assert result.exchanged()["coil"] >= EXCHANGED
    assert result.energy_error <= tol.ENERGY
    # one degree of freedom with the inertia J + 9 J: a harmonic motion of known frequency
    assert np.max(angles[:, 0]) == pytest.approx(8.0, rel=1e-3)


# --- work of inputs and loads -----------------------------------------------------------------------------

DEAD = np.array([0.3, -0.2, 0.5])
ENDS = np.array([0.3, 0.1, 0.0]), np.array([-0.2, 0.2, 0.1])
"""Ends of the damper in the axes of either body."""
TIP, LOSS = np.array([0.3, -0.2, 0.2]), 3.0


@cache
def loaded(size):
    """A free pair with everything that works on it; `size` of the loads from outside, a number."""
    scene = nc.Scene()
    place = np.array([1.0, 0.2, 0.0])
    one = scene.add(nc.RigidBody(mass=1.0, inertia=(0.2, 0.3, 0.4), com=(0.1, 0.0, 0.05), name="one"))
    two = scene.add(nc.RigidBody(mass=2.0, inertia=(0.5, 0.4, 0.3), position=place, name="two"))
    hinge = scene.add(nc.Cylindrical(one, two, point=(0.5, 0.1, 0.0), axis=(1.0, 0.0, 1.0)))
    triad = tuple(nc.Direction(one, axis) for axis in np.eye(3))
    point = nc.Point(two, place + TIP)

    def wave(t):
        return size * jnp.stack([0.2 * jnp.cos(t), jnp.sin(t), jnp.zeros_like(t)])

    scene.add(nc.JointTorque(hinge, name="torque"))
    scene.add(nc.JointForce(hinge, coordinate=0, name="turner"))
    scene.add(nc.JointForce(hinge, coordinate=1, name="pusher"))
    scene.add(nc.BodyTorqueInput(triad, name="wheels"))
    scene.add(nc.BodyForceInput((point, nc.Direction(two, (0.0, 1.0, 0.0))), name="thruster"))
    scene.add(nc.PointForce((point,), name="dead", force=size * DEAD))
    scene.add(nc.PointForce((point, *triad), name="follower", force=wave, following=True))
    scene.add(nc.BodyTorque(triad[:1], name="twist", torque=size * np.array([0.1, 0.4, -0.2])))
    torque = size * np.array([0.1, 0.1, 0.3])
    scene.add(nc.BodyTorque(triad, name="following twist", torque=torque, following=True))
    scene.add(nc.PairTorque((triad[2], nc.Direction(two, (0.0, 0.0, 1.0))), name="pair", torque=0.3))
    ends = nc.Point(one, ENDS[0]), nc.Point(two, place + ENDS[1])
    scene.add(nc.Damper(ends, name="damper", damping=LOSS))
    return scene.compile()


def worked(size, dt, inputs):
    system, state = loaded(size)
    trajectory = nc.simulate(system, state, dt=dt, inputs=jnp.asarray(inputs))
    return system, trajectory, account(system, trajectory)


def placed(system, trajectory, body, local):
    """Where a point of a body is, by NumPy."""
    q = rows(trajectory.q)[:, system.body_index(body)]
    return q[:, 0] + np.einsum("k,tkc->tc", local, q[:, 1:])


def test_work_accounts():
    """Each entry is force times displacement, and together they are the change of energy."""
    dt = 0.03
    count = len(loaded(1.0)[0].structure.inputs)
    waves = np.sin(np.outer((np.arange(200) + 0.5) * dt, 1.0 + 0.3 * np.arange(count)))
    system, trajectory, result = worked(1.0, dt, waves)
    assert len(result.works) == 11
    assert min(np.ptp(w) for w in result.works.values()) >= 1e-3 * result.energy_scale
    assert result.turned >= 1.0
    assert result.energy_error <= tol.ENERGY
    coordinates = np.diff(np.asarray(trajectory.states.coordinates), axis=0)
    for number, name in enumerate(("turner", "pusher")):
        work = waves[:, system.input_index(name)] * coordinates[:, number]
        assert np.max(np.abs(np.diff(result.works[name]) - work)) <= tol.STEP_BALANCE * result.energy_scale
    where = placed(system, trajectory, "two", TIP)
    work = (where - where[0]) @ DEAD
    assert np.max(np.abs(result.works["dead"] - work)) <= tol.STEP_BALANCE * result.energy_scale * 200


def test_internal_inputs_keep_momenta():
    """Motors act with their opposites: no impulse, no angular impulse, whatever the step.

    A damper between points loses c (rate of the mid-point length)^2 h, no more and no less.
    """
    dt, system = 0.05, loaded(0.0)[0]
    inputs = np.zeros((100, len(system.structure.inputs)))
    for name, value in {"torque": 0.3, "turner": 0.2, "pusher": 0.5}.items():
        inputs[:, system.input_index(name)] = value
    system, trajectory, result = worked(0.0, dt, inputs)
    assert result.turned >= 1.0
    assert result.energy_error <= tol.ENERGY
    assert result.momentum_error() <= tol.MOMENTUM
    impulse = 100 * dt * (0.3 + 0.2 + 0.3)
    assert result.spin_error(impulse=impulse) <= tol.ANGULAR_MOMENTUM
    line = placed(system, trajectory, "two", ENDS[1]) - placed(system, trajectory, "one", ENDS[0])
    middle, step = 0.5 * (line[1:] + line[:-1]), np.diff(line, axis=0)
    stretched = np.einsum("tc,tc->t", middle, step) / np.linalg.norm(middle, axis=1)
    lost = LOSS * stretched**2 / dt
    assert np.sum(lost) >= 0.05 * result.energy_scale
    assert np.max(np.abs(np.diff(result.works["damper"]) + lost)) <= tol.STEP_BALANCE * result.energy_scale


def test_impulse_of_torques_is_the_change_of_angular_momentum():
    """h m enters the balance whatever the step: torque inputs along the axes of a body (61)."""
    dt, system = 0.1, loaded(0.0)[0].set("pair", torque=0.0)
    torques = np.random.default_rng(0).normal(size=(100, 3))
    inputs = np.zeros((100, len(system.structure.inputs)))
    inputs[:, [system.input_index(f"wheels[{k}]") for k in range(3)]] = torques
    trajectory = nc.simulate(system, loaded(0.0)[1], dt=dt, inputs=jnp.asarray(inputs))
    result = account(system, trajectory)
    d = rows(trajectory.q)[:, system.body_index("one"), 1:]
    impulses = dt * np.einsum("ti,tic->tc", torques, 0.5 * (d[1:] + d[:-1]))
    change = np.diff(result.spins.sum(1), axis=0)
    scale = np.max(np.linalg.norm(result.spins.sum(1), axis=1)) + np.sum(np.abs(torques)) * dt
    assert relative(np.max(np.abs(change - impulses)), scale) <= tol.STEP_BALANCE


# --- all schemes ------------------------------------------------------------------------------------------


def beat(t):
    """Angle of the driven hinge [rad]."""
    return 0.6 * (1 - jnp.cos(3.0 * t))


@cache
def machine():
    """A free hub with an arm on a motor and a driven fin; a spring with a law of its own, and a damper.

    All forces are internal: both momenta are kept. It drifts, lest momentum be zero.
    """
    scene = nc.Scene()
    drift, spin = np.array([0.4, -0.2, 0.3]), np.array([0.3, -0.5, 1.0])

    def part(name, place, inertia):
        moving = {"velocity": drift + np.cross(spin, place), "angular_velocity": spin}
        com = (0.1, 0.05, -0.02)
        return scene.add(
            nc.RigidBody(mass=1.0, inertia=inertia, com=com, position=place, **moving, name=name)
        )

    hub = part("hub", (0.0, 0.0, 0.0), (0.3, 0.4, 0.5))
    arm = part("arm", (0.5, 0.0, 0.0), (0.1, 0.15, 0.2))
    fin = part("fin", (-0.5, 0.0, 0.0), (0.08, 0.1, 0.12))
    elbow = scene.add(nc.Revolute(hub, arm, point=(0.3, 0.0, 0.0), axis=(0.0, 1.0, 0.5), name="elbow"))
    root = scene.add(nc.Revolute(hub, fin, point=(-0.3, 0.0, 0.0), axis=(1.0, 0.0, 0.2), name="root"))
    scene.add(nc.JointTorque(elbow, name="motor"))
    scene.add(nc.Drive(root, function=beat, name="drive"))
    ends = nc.Point(hub, (0.0, 0.4, 0.1)), nc.Point(arm, (0.7, 0.1, 0.2))
    law = lambda x: 40.0 * (x - 0.5) ** 2 + 60.0 * (x - 0.5) ** 4  # noqa: E731
    scene.add(nc.NonlinearSpring(ends, name="spring", law=law))
    tips = nc.Point(arm, (0.8, 0.0, 0.0)), nc.Point(fin, (-0.7, 0.1, 0.0))
    scene.add(nc.Damper(tips, name="damper", damping=0.8))
    return scene.compile()


KICKS = [(order, kick) for order in ORDERS for kick in (True, False) if (order, kick) != (2, False)]


@pytest.mark.parametrize(("order", "kick"), [lane(case, set(), set()) for case in KICKS])
def test_a_machine_with_motor_drive_damper_and_spring(order, kick):
    """Energy is the work done, momenta are kept, velocities are tangent with kicks.

    Could go wrong: a coefficient of five stages that is right to ten digits; work that is summed up with
    other weights than the motion; a quadrature of the spring's forces that is exact for few stages only.
    """
    system, state = machine()
    scheme, dt, steps = nc.EnergyMomentum(order=order, kick=kick), 0.05, 100
    torques = 2.0 * jnp.sin(2.0 * scheme.times(dt, steps))[..., None]
    inputs = torques[:, 0] if order == 2 else torques
    trajectory = nc.simulate(system, state, dt=dt, inputs=inputs, scheme=scheme)
    result = account(system, trajectory)
    assert result.turned >= 1.0
    assert result.exchanged()["spring"] >= 0.1
    assert sorted(result.works) == ["damper", "drive", "motor"]
    assert min(np.ptp(result.works[name]) for name in ("damper", "motor")) >= 0.1 * result.energy_scale
    assert np.ptp(result.works["drive"]) >= 0.01 * result.energy_scale
    assert np.all(np.diff(result.works["damper"]) < 0), "a damper gives no energy"
    assert result.energy_error <= tol.ENERGY_OF_A_SMALL_SCENE
    assert result.momentum_error() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert result.spin_error() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert max(result.directors, result.joints) <= tol.CONSTRAINT_OF_A_SMALL_SCENE
    rates = float(jnp.max(system.constraint_errors(trajectory).velocity))
    if kick:
        assert rates <= tol.TANGENT_OF_A_SMALL_SCENE
    else:
        assert rates > tol.TANGENT, "velocities are tangent without kicks: the comparison means nothing"
    if order >= 4:
        angle = np.asarray(system.coordinate(trajectory, "root"))
        np.testing.assert_allclose(angle, np.asarray(beat(trajectory.t)), atol=tol.CONSTRAINT)


@cache
def driven():
    """A prescribed hinge with a link on a spring, a damper, a motor, a rotor and a load behind it."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    one = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.2), com=(0.25, 0, 0.1), name="one"))
    two = scene.add(
        nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.3), com=(0.2, 0, 0), position=(0.5, 0, 0), name="two")
    )
    first = scene.add(nc.Revolute(nc.ground, one, point=(0, 0, 0), axis=(0.0, 1.0, 0.0), name="first"))
    second = scene.add(
        nc.Universal(one, two, point=(0.5, 0, 0), axis=(0, 0, 1), second=(0, 1, 0), name="second")
    )
    scene.add(nc.Drive(first, function=lambda t: 0.7 * (1 - jnp.cos(3.0 * t)), name="drive"))
    scene.add(nc.JointSpring(second, stiffness=20.0))
    scene.add(nc.JointDamper(second, damping=0.1, coordinate=1))
    scene.add(nc.Armature(second, inertia=0.05, coordinate=1))
    scene.add(nc.JointTorque(second, name="motor"))
    scene.add(nc.Spring((nc.Point(nc.ground, (0, 0.3, -0.4)), nc.Point(two, (0.8, 0, 0))), stiffness=50.0))
    scene.add(nc.PointForce((nc.Point(two, (0.9, 0, 0)),), force=lambda t: jnp.stack([0.0 * t, t, 0.0 * t])))
    return scene.compile(assemble=True)


OTHERS = {"variational": VARIATIONAL, "dissipative": DISSIPATIVE}


@pytest.mark.parametrize("name", [lane((name,), set(), set()) for name in OTHERS])
def test_work_of_drives_inputs_and_dampers(name):
    """The balance closes: exactly, or by the square of the step in a scheme whose energy is not exact."""
    system, state = driven()
    errors = []
    for steps in (100, 200):
        inputs = jnp.full((steps, 1), 0.3)
        trajectory = nc.simulate(system, state, dt=1.0 / steps, inputs=inputs, scheme=OTHERS[name])
        result = account(system, trajectory)
        assert abs(result.works["drive"][-1]) > 0.02 * result.energy_scale
        assert result.joints <= tol.CONSTRAINT
        errors.append(result.energy_error)
        if name == "dissipative":
            # Energy never grows by more than the work: what is dissipated in a step is never negative.
            lost = -np.diff(result.works["numerical dissipation"])
            assert np.min(lost) >= -tol.STEP_BALANCE * result.energy_scale and np.sum(lost) > 0
    if name == "variational":
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.3)
    else:
        assert max(errors) <= tol.ENERGY


# --- the free spacecraft, over very many steps; balances of batches and of saved states --------------------


def spinning_craft():
    """The spacecraft of the paper, motors idle, all parts spinning, the common centre of mass at rest."""
    spin, wheels = np.array([0.3, -0.2, 0.4]), (2.0, -3.0, 4.0)
    places = [distance * np.eye(3)[k] for k, (_, _, distance) in enumerate(WHEELS)]
    masses = [mass for mass, _, _ in WHEELS]
    centre = np.average(np.array([np.zeros(3), *places]), axis=0, weights=[BASE[0], *masses])
    drift = -np.cross(spin, centre)
    scene = nc.Scene()
    moving = {"velocity": drift, "angular_velocity": spin}
    base = scene.add(nc.RigidBody(mass=BASE[0], second_moment=BASE[1], **moving, name="base"))
    for k, (mass, moment, distance) in enumerate(WHEELS):
        axis = np.eye(3)[k]
        place = distance * axis
        moving = {"velocity": drift + np.cross(spin, place), "angular_velocity": spin + wheels[k] * axis}
        wheel = nc.RigidBody(mass=mass, second_moment=moment, position=place, **moving, name=f"wheel {k + 1}")
        scene.add(nc.Revolute(base, scene.add(wheel), point=place, axis=axis))
    return scene.compile()


@pytest.mark.exhaustive
def test_free_spacecraft_over_20000_steps():
    """At any step: one program."""
    system, state = spinning_craft()
    for dt in (1e-1, 1e-3, 1e-6, 1e-9):
        result = account(system, nc.simulate(system, state, dt=dt, steps=20_000, save_every=40))
        assert result.energy_error <= tol.LONG_ENERGY, dt
        assert result.directors <= tol.LONG_DIRECTORS, dt
        assert result.joints <= tol.CONSTRAINT, dt
        assert result.spin_error() <= tol.ANGULAR_MOMENTUM, dt
        assert result.momentum_error() <= tol.MOMENTUM, dt


@pytest.mark.exhaustive
def test_a_batch_has_the_balances_of_its_lanes():
    scene = nc.Scene()
    scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), angular_velocity=(0, 1, 0.1)))
    system, state = scene.compile()
    runs = jax.vmap(lambda dt: nc.simulate(system, state, dt=dt, steps=3))(jnp.array([0.1, 0.2]))
    result = nc.balance(system, runs)
    assert result.energy.shape == result.momentum.shape == (2, 4) and result.axes == 3
    for k in range(2):
        np.testing.assert_array_equal(
            result.angular_momentum[k], nc.balance(system, runs[k]).angular_momentum
        )


@pytest.mark.exhaustive
@pytest.mark.parametrize("weight", [0.0, 9.81])
def test_momenta_are_judged_where_not_every_step_is_there(weight):
    """Where only internal forces act: their resultants are rounding. Impulses of others are not known."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -weight)))
    one = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.2), angular_velocity=(1, 0, 2)))
    other = scene.add(nc.RigidBody(mass=2.0, inertia=(0.1, 0.2, 0.2), position=(1, 0, 0), velocity=(0, 1, 0)))
    scene.add(nc.Spring((nc.Point(one, (0.1, 0.2, 0)), nc.Point(other)), stiffness=50.0))
    system, state = scene.compile()
    result = nc.balance(system, nc.simulate(system, state, dt=DT, steps=100, save_every=5))
    assert result.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    if weight:
        assert result.momentum is None and "made in parts or not saved" in result.note
    else:
        assert result.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE and result.directions == 3
        assert result.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE and result.axes == 3


def test_errors_are_relative_to_what_is_no_rounding():
    """Bodies that meet head-on have no angular momentum, and one that only turns has no momentum."""
    scene = nc.Scene()
    bodies = [
        nc.RigidBody(mass=1.0 + k, inertia=(0.1, 0.2, 0.3), position=(0.3 + k, 0, 0), name=f"body {k}")
        for k in range(2)
    ]
    bodies = [scene.add(body) for body in bodies]
    scene.add(nc.Spring(tuple(map(nc.Point, bodies)), stiffness=50.0, length=0.9))
    system, state = scene.compile()
    speeds = np.zeros((2, 8, 3))
    speeds[0, 0] = (1.3, 0.0, 0.0)
    speeds[1, 5:] = np.cross((0.3, -1.0, 0.4), np.eye(3))
    starts = jax.vmap(lambda v: dataclasses.replace(state, v=v))(jnp.asarray(speeds))
    runs = jax.vmap(lambda s: nc.simulate(system, s, dt=DT, steps=50))(starts)
    errors = nc.balance(system, runs)
    assert errors.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert errors.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    # What is no number is no error of zero.
    broken = dataclasses.replace(runs[0], states=jax.tree.map(lambda x: x * jnp.nan, runs[0].states))
    assert np.isnan(nc.balance(system, broken).energy).all()


def test_states_after_the_end_are_no_steps():
    """Of a run with error control that an event ends early, and of its parts."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.3), angular_velocity=(0.1, 9.0, 0.2), name="body"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=0.1, steps=200, until=lambda s: 0.45 - s.t, rtol=1e-5)
    assert 5 < run.steps_taken < 200
    for part in (run, run[:4], run[2:60]):
        errors = nc.balance(system, part)
        assert errors.momentum is None and "made in parts or not saved" in errors.note


class Anchored(nc.Potential):
    """Three springs along the axes of the world, which no free pair of bodies knows of."""

    stiffness: float = 5.0

    def invariants(self, x):
        return x[1] - x[0]

    def energy(self, stretch):
        return self.stiffness * jnp.array([1.0, 2.0, 3.0]) @ stretch**2


def test_what_turns_the_whole_from_within_is_named():
    scene = nc.Scene()
    one = scene.add(nc.PointMass(mass=1.0, velocity=(0, 1, 0.3), name="one"))
    two = scene.add(nc.PointMass(mass=2.0, position=(1, 0, 0), velocity=(0.2, -1, 0), name="two"))
    scene.add(Anchored((nc.Point(one), nc.Point(two)), name="anchored"))
    scene.add(Anchored((nc.Point(nc.ground), nc.Point(one)), stiffness=0.0, name="from outside"))
    with pytest.warns(UserWarning, match="'anchored' turns all bodies .* marker of nc.ground") as said:
        system, state = scene.compile()
    assert len(said) == 1
    run = nc.simulate(system, state, dt=0.05, steps=100)
    turned = np.linalg.norm(system.angular_momentum(run) - system.angular_momentum(state), axis=1).max()
    errors = nc.balance(system, run)
    assert f"'anchored' turns the whole by {turned:.2g} N m s" in errors.note
    assert errors.angular_momentum.max() > 0.1 and errors.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE


class Skewed(nc.Constraint):
    """Keeps what the world has of a distance, which no free pair of bodies knows of."""

    multipliers = 1

    def residual(self, x):
        return (x[1] - x[0])[:1] - 1.0


class Wind(nc.Force):
    """On both of its points, from outside."""

    def load(self, x, rate, inputs, t):
        return nc.Load(jnp.broadcast_to(jnp.array([0.0, 0.3, 0.0]), x.shape), None)


@pytest.mark.slow
def test_constraints_that_turn_the_whole_are_named_and_loads_are_not():
    """What a constraint does to all is no reaction of the ground; a load on two points is from outside."""
    scene = nc.Scene()
    one = scene.add(nc.PointMass(mass=1.0, velocity=(0, 1, 0.3), name="one"))
    two = scene.add(nc.PointMass(mass=2.0, position=(1, 0.5, 0), velocity=(0, -1, 0), name="two"))
    ends = (nc.Point(one), nc.Point(two))
    scene.add(nc.Spring(ends, stiffness=5.0, length=0.1))
    scene.add(Skewed(ends, name="skewed"))
    scene.add(Wind(ends, name="wind"))
    with pytest.warns(UserWarning, match="'skewed' turns all bodies"):
        system, state = scene.compile()
    errors = nc.balance(system, nc.simulate(system, state, dt=0.05, steps=50))
    assert errors.note.startswith("not conserved: reactions of 'skewed' push or turn the whole")
    assert "wind" not in errors.note and errors.directions == errors.axes == 3
    assert errors.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE and errors.angular_momentum.max() > 1e-3
