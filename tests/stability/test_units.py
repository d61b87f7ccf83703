"""Every effect of the contract table in other units: of length, time and mass, by what its docstring says.

And turned. What could go wrong: metres, seconds or kilograms are written into a tolerance, a guess or a law,
so that what is small, slow or light moves otherwise; a docstring says another unit than the law has; an axis
of space is written into a law.
"""

import dataclasses
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from scenes import AXIS, SECOND, SPECIAL, with_multipliers
from test_contracts import TABLE, Parts, turned

import natcoord_jax as nc

BASES = {"m": (1, 0, 0), "s": (0, 1, 0), "kg": (0, 0, 1), "N": (1, -2, 1), "J": (2, -2, 1)}
"""Powers of length, time and mass in units; others have none."""
OTHERS = np.array(
    [(1, 1, 1), (1e-3, 1, 1), (1e-6, 1e-3, 1e-6), (1e4, 1e3, 1e6), (1, 1e-3, 1e3), (1e-4, 10, 1)]
)
"""Lengths, times and masses, as they are and in other units."""

TURNS = np.stack([np.eye(3)] * len(OTHERS) + [turned((0.3, -1.1, 0.8)), turned((-2.0, 0.5, 1.5))])
"""Of the lanes above, none; then two."""
OTHERS_AND_TURNED = np.concatenate([OTHERS, np.ones((2, 3))])

FUNCTIONS = {
    nc.Drive: ("s", "rad"),
    nc.NonlinearSpring: ("m", "J"),
    nc.JointPotential: ("rad", "J"),
    nc.PointForce: ("s", "N"),
    nc.BodyTorque: ("s", "N m"),
    nc.EdgeSegment: ("s", "N/m"),
    **dict.fromkeys((nc.FacePressure, nc.FacePressure6, nc.FacePressure8, nc.FacePressure9), ("s", "N/m^2")),
}
"""Units of the argument and the value of the function that an effect has."""
INPUTS = {nc.JointForce: "N", nc.BodyForceInput: "N", nc.WrenchInput: "-", nc.AffineActuator: "-"}
"""Units of inputs that are no torques."""
ASIDE = {
    nc.PointOnPoint: "it repeats what the joint holds, which is found out outside of jit only",
    nc.PointSum: "it repeats what the joint holds, which is found out outside of jit only",
}


class Hardening(eqx.Module):
    """A law of a beam with numbers of its own.

    Attributes:
        tension: of the three strains [N].
        bending: of the three curvatures [N m^2].
    """

    tension: Any
    bending: Any

    def __call__(self, strains):
        return self.tension @ jnp.cosh(strains[:3]) + self.bending @ strains[3:] ** 2


# With numbers that fit the pair as it starts.
FITTING = {
    nc.NonlinearBeamElement: lambda p: dataclasses.replace(
        TABLE[nc.NonlinearBeamElement].make(p),
        law=Hardening(np.array((5.0, 3.0, 2.0)), np.array((0.5, 0.3, 0.7))),
    ),
    nc.PointOnPlane: lambda p: nc.PointOnPlane((p.ends[0], p.triad[2], p.ends[1]), distance=-0.7),
    nc.PointOnLine: lambda p: nc.PointOnLine((p.ends[0], nc.Direction(p.one, (0.8, 0.8, -0.7)), p.ends[1])),
    nc.Rolling: lambda p: nc.Rolling((p.ends[0], nc.Direction(p.one, (0, 0, -1)), p.ends[1]), radius=0.7),
    nc.JointFriction: lambda p: nc.JointFriction(p.joint, friction=0.5),
}
# Numbers of more units than one.
MIXED = {
    nc.Coupling: lambda units: {"factors": jnp.stack([jnp.ones(()), -0.7 / units[0]])},
    nc.AffineActuator: lambda units: {
        "gear": jnp.stack([jnp.full((), 2.0), -0.5 / units[0]]),
        "gain": scale("N m", units) * jnp.array((3.0, 0.4, 0.2)).at[2].multiply(units[1]),
        "bias": scale("N m", units) * jnp.array((0.3, -5.0, -0.7)).at[2].multiply(units[1]),
    },
}
SOME = nc.Screw, nc.Drive, nc.BeamElement


class Scaled(eqx.Module):
    """A function in other units."""

    function: Any = eqx.field(static=True)
    argument: Any
    value: Any

    def __call__(self, x):
        return self.value * self.function(x / self.argument)


def scale(unit: str, units) -> Any:
    """Of a unit as "N m/rad", in units of length, time and mass."""
    above, *below = unit.split("/")
    powers = np.zeros(3)
    for text, sign in [(above, 1), *((x, -1) for x in below)]:
        for factor in text.split():
            base, _, power = factor.partition("^")
            powers += sign * float(power or 1) * np.array(BASES.get(base, (0, 0, 0)))
    return jnp.prod(units**powers)


def unit_of(kind: type, name: str) -> str:
    """As the docstring of a class has it."""
    for owner in kind.__mro__:
        text = (owner.__doc__ or "") + "\n"
        entry = re.search(rf"^( *){name}: ?((?:.*\n)(?:\1 +.*\n)*)", text, re.MULTILINE)
        unit = re.search(r"\[([^\[\]]+)\]", entry[2]) if entry else None
        if unit:
            return unit[1]
    return "-"


def in_units(part: Any, units: Any, slides: bool, turn: Any) -> Any:
    """A part with all its numbers in other units; `slides`: of a joint coordinate that is a displacement."""
    length, changes = units[0], {}
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if field.name == "markers":
            changes["markers"] = tuple(placed(marker, length, turn) for marker in value or ())
        elif callable(value) and not isinstance(value, eqx.Module | type):
            argument, result = (scale(unit, units) for unit in FUNCTIONS[type(part)])
            changes[field.name] = Scaled(value, argument, result)
        elif isinstance(value, eqx.Module):
            changes[field.name] = in_units(value, units, slides, turn)
        elif field.init and not field.metadata.get("static") and is_floating(value):
            first, *more = unit_of(type(part), field.name).split(",")
            choices = first.split(" or ")
            factor = scale(choices[-1 if slides else 0], units)
            shape, bends = np.shape(value), jnp.ones(6).at[3:].set(length)
            if more and shape == (6, 6):  # of strains and curvatures
                factor = factor * bends[:, None] * bends
            elif more and shape[-1:] == (6,):
                factor = factor / bends
            changes[field.name] = factor * jnp.asarray(value)
            if isinstance(part, nc.Gravity):
                changes[field.name] = turn @ changes[field.name]
    if not changes.get("markers", True):
        del changes["markers"]
    return dataclasses.replace(part, **changes)


def is_floating(value: Any) -> bool:
    if value is None or isinstance(value, str | bool | int):
        return False
    try:
        return np.asarray(value).dtype.kind == "f"
    except TypeError:
        return False


def placed(marker: Any, length: Any, turn: Any) -> Any:
    """A point, a direction or an attachment in another unit of length, turned with all of the scene."""
    if isinstance(marker, nc.Attachment):
        axes = turn @ jnp.asarray(marker.axes)
        return dataclasses.replace(marker, point=length * turn @ jnp.asarray(marker.point), axes=axes)
    vector = (length if marker.is_point else 1.0) * jnp.asarray(marker.vector, float)
    return dataclasses.replace(marker, vector=turn @ vector)


def moved(effect: type, units: Any, turn: Any) -> Any:
    """The pair of the table after a step, without units and turned back: places, speeds, energy."""
    (length, time, mass), entry, scene = units, TABLE[effect], nc.Scene()

    def body(mass_of, inertia, com, place, spin, orientation, name):
        part = nc.RigidBody(
            mass=mass * mass_of,
            inertia=mass * length**2 * np.array(inertia),
            com=length * np.array(com),
            position=length * turn @ np.array(place),
            orientation=turn @ orientation,
            velocity=length / time * turn @ np.array(spin[::-1]),
            angular_velocity=turn @ np.array(spin) / time,
            name=name,
        )
        return scene.add(part)

    upright, aslant = np.eye(3), turned(0.7 * np.array(AXIS) / np.linalg.norm(AXIS))
    one = body(2.0, (0.3, 0.4, 0.5), (0.05, -0.03, 0.1), (0, 0, -1.0), (0.4, -0.3, 0.5), upright, "one")
    two = body(1.5, (0.2, 0.12, 0.25), (0, 0, 0), (0.5, 0.3, -1.6), (-0.2, 0.6, 0.3), aslant, "two")
    kind = entry.joint if entry.make else with_multipliers(entry.joint)
    options = {
        key: length * (turn @ np.array(x) if np.ndim(x) else x)
        for key, x in SPECIAL.get(entry.joint, {}).items()
    }
    axes = {"axis": turn @ np.array(AXIS), "second": turn @ np.array(SECOND)}
    place = length * turn @ np.array((0.2, 0.1, -1.3))
    joint = scene.add(kind(one, two, point=place, **axes, name="joint", **options))
    if entry.make:
        made: Any = FITTING.get(effect, entry.make)(Parts(one, two, joint))
        number = getattr(made, "coordinate", 0)
        number = number if isinstance(number, int) else 0
        slides = bool(entry.joint.coordinates) and entry.joint.coordinates[number].unit == "m"
        made = in_units(made, units, slides, turn)
        scene.add(dataclasses.replace(made, **MIXED[effect](units)) if effect in MIXED else made)
    system, state = scene.compile()
    inputs = (0.5 + jnp.arange(len(system.structure.inputs))) * scale(INPUTS.get(effect, "N m"), units)
    after = nc.step(system, state, inputs, dt=0.05 * time)
    energy = system.energy(after).total / scale("J", units)
    rows, rates = after.rows @ turn, after.row_rates @ turn * time
    sizes = jnp.ones(4).at[0].set(length)[:, None]
    return rows / sizes, rates / sizes, energy


@pytest.mark.parametrize(
    "effect",
    [
        pytest.param(e, marks=pytest.mark.slow if e in SOME else pytest.mark.exhaustive)
        for e in TABLE
        if e not in ASIDE
    ],
    ids=lambda e: e.__name__,
)
def test_units_of_length_time_and_mass(effect):
    """A step from micrometres to tens of kilometres, milliseconds to kiloseconds, milligrams to kilotons.

    And in two other directions of space.
    """
    steps = jax.jit(jax.vmap(lambda units, turn: moved(effect, units, turn)))
    lanes = [np.asarray(x) for x in steps(OTHERS_AND_TURNED, TURNS)]
    assert np.isfinite(lanes[0][0]).all()
    for lane in lanes:
        off = np.abs(lane - lane[0]).reshape(len(lane), -1).max(axis=1) / max(1.0, np.abs(lane[0]).max())
        assert off.max() <= tol.SAME_TRAJECTORY, off


# --- what lengths are compared with -----------------------------------------------------------------------

LENGTHS = np.array([1.0, 1e-1, 1e-3, 1e-4, 1e-6, 1e3])


def rolling(length, com):
    """A ball on an incline, rolling and turning, by its size."""
    scene, radius, spin = nc.Scene(), 0.1 * length, np.array((3.0, -2.0, 1.0))
    scene.add(nc.Gravity(vector=length * np.array((1.0, 0.5, -9.81))))
    start = {"position": radius * np.array([0, 0, 1]), "velocity": radius * np.cross(spin, (0, 0, 1))}
    inertia = 1.6 * radius**2 * np.ones(3)
    ball = nc.RigidBody(mass=4.0, inertia=inertia, com=length * com, **start, angular_velocity=spin)
    ball = scene.add(ball)
    table = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
    scene.add(nc.Rolling((*table, nc.Point(ball)), radius=radius, name="rolling"))
    return *scene.compile(), ball


@pytest.mark.slow
def test_accelerations_of_what_rolls_do_not_know_its_size():
    """Of a uniform ball 5/7 of the pull; of one that is not what it has at one metre."""

    def acceleration(length, com):
        system, state, ball = rolling(length, com)
        return system.sense(state, ball).acceleration / length

    places = np.array([(0.0, 0.0, 0.0), (0.02, 0.01, -0.015)])
    found = np.asarray(jax.jit(jax.vmap(jax.vmap(acceleration, (None, 0)), (0, None)))(LENGTHS, places))
    assert np.abs(found[:, 0] - 5 / 7 * np.array((1.0, 0.5, 0.0))).max() <= 1e-13
    assert np.abs(found[:, 1] - found[0, 1]).max() <= 1e-13


def loop(length):
    """A parallelogram of three bars."""
    scene, upright = nc.Scene(), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    places = ((0, 0, 0), upright), ((0, 1, 0), np.eye(3)), ((1, 0, 0), upright)
    bars = [
        scene.add(
            nc.RigidBody(
                mass=1.0,
                inertia=length**2 * np.array((0.1, 0.2, 0.2)),
                com=length * np.array((0.5, 0, 0)),
                position=length * np.array(place, float),
                orientation=frame,
            )
        )
        for place, frame in places
    ]
    pairs = ((nc.ground, 0, (0, 0, 0)), (0, 1, (0, 1, 0)), (1, 2, (1, 1, 0)), (nc.ground, 2, (1, 0, 0)))
    hinges = [
        scene.add(
            nc.Revolute(one if one is nc.ground else bars[one], bars[two], point=length * np.array(at, float))
        )
        for one, two, at in pairs
    ]
    return *scene.compile(), hinges[0]


def test_a_loop_that_is_open_by_part_of_its_size_is_refused():
    """By 1e-4 of it, of a micrometre, too."""
    system, state, hinge = loop(1e-6)
    with pytest.raises(ValueError, match="violates joint"):
        nc.simulate(system, system.with_coordinate(state, hinge, 1e-4), dt=0.01, steps=1)


@pytest.mark.slow
def test_loops_of_all_sizes_are_closed():
    """To round-off of their size."""
    for length in (1e-6, 1.0, 1e4):
        system, state, hinge = loop(length)
        closed = nc.assemble(system, system.with_coordinate(state, hinge, 0.3))
        assert float(system.coordinate(closed, hinge)) == pytest.approx(0.3, abs=1e-12)
        assert float(system.constraint_errors(closed).joints) <= 1e-14 * max(1.0, length)


@pytest.mark.exhaustive
@pytest.mark.parametrize("events", [8, 0], ids=["located", "at ends of steps"])
def test_impacts_do_not_know_lengths_and_times(events):
    """A ball that is thrown on a floor with friction, from tens of nanometres to kilometres."""

    def flight(length, time):
        scene = nc.Scene()
        scene.add(nc.Gravity(vector=-10.0 * length / time**2 * np.array([0, 0, 1])))
        start = {
            "position": 0.153 * length * np.array([0, 0, 1]),
            "velocity": length / time * np.array([1, 0, 0]),
        }
        shape = nc.Sphere(0.1 * length)
        ball = scene.add(nc.RigidBody(shape=shape, density=1e3 / length**3, **start, name="ball"))
        scene.add(nc.Contact(ball, nc.Plane(), restitution=0.8, friction=0.3, name="floor"))
        system, state = scene.compile()
        scheme = nc.EnergyMomentum(max_events=events)
        run = nc.simulate(system, state, dt=0.01 * time, steps=60, scheme=scheme)
        return run.result, system.sense(run, ball).position / length

    lengths, times = np.array([(1, 1), (1e-3, 1), (1e-6, 1e-3), (1e-8, 1), (1e3, 1e2)]).T
    codes, places = map(np.asarray, jax.jit(jax.vmap(flight))(lengths, times))
    assert not codes.any()
    assert np.abs(places - places[0]).max() <= 1e-11
    assert places[0][30:, 2].max() >= 0.11, "it does not rebound: nothing is tested"


@pytest.mark.slow
@pytest.mark.parametrize("falls", [True, False])
def test_friction_in_joints_does_not_know_units(falls):
    """A slide and a hinge that stick and slip: where they fall, or a motor moves what rests in space."""

    def moved(units):
        (length, time, mass), scene = units, nc.Scene()
        force, torque = (scale(unit, units) for unit in ("N", "N m"))
        slope = np.array((3.0, 0.0, -9.0)) if falls else np.zeros(3)
        scene.add(nc.Gravity(vector=length / time**2 * slope))
        inertia = {"mass": 2.0 * mass, "inertia": mass * length**2 * np.array((0.1, 0.2, 0.3))}
        carriage = scene.add(nc.RigidBody(**inertia, name="carriage"))
        slide = scene.add(nc.Prismatic(nc.ground, carriage, axis=(1, 0, 0), name="slide"))
        arm = scene.add(nc.RigidBody(**inertia, position=length * np.array((0.4, 0, 0)), name="arm"))
        hinge = scene.add(nc.Revolute(carriage, arm, axis=(0, 1, 0), name="hinge"))
        scene.add(nc.JointFriction(slide, friction=4.0 * force))
        scene.add(nc.JointFriction(hinge, friction=0.5 * torque))
        scene.add(nc.JointForce(slide, gear=force, name="push"))
        scene.add(nc.JointTorque(hinge, gear=torque, name="motor"))
        system, state = scene.compile()
        run = nc.simulate(system, state, dt=0.02 * time, steps=20, inputs=jnp.array([6.0, 1.0]))
        return run.result, run.q[:, 0::4] / length, run.q[:, 5]

    codes, places, axes = map(np.asarray, jax.jit(jax.vmap(moved))(OTHERS))
    assert not codes.any()
    assert np.abs(places[0, -1] - places[0, 0]).max() >= 1e-2, "it does not move: nothing is tested"
    for lanes in (places, axes):
        assert np.abs(lanes - lanes[0]).max() <= tol.SAME_TRAJECTORY


@pytest.mark.slow
def test_of_normals_only_their_direction_counts():
    """Of two or half the length: constraints, gaps and forces are the same."""
    for size in (1.0, 2.0, 0.5):
        scene, normal = nc.Scene(), (nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, size)))
        moving = {"velocity": (1.0, 0, 0), "angular_velocity": (0, 2.0, 0)}
        wheel = scene.add(nc.RigidBody(shape=nc.Sphere(0.5), density=1.0, position=(0, 0, 0.5), **moving))
        scene.add(nc.Rolling((*normal, nc.Point(wheel)), radius=0.5))
        bead = scene.add(nc.PointMass(mass=1.0, position=(3, 0, 1.0)))
        scene.add(nc.PointOnPlane((*normal, nc.Point(bead)), distance=1.0))
        ball = scene.add(nc.PointMass(mass=1.0, position=(5, 0, 0.4), name="ball"))
        scene.add(
            nc.GapPotential((*normal, nc.Point(ball)), nc.SphereOnPlane(radius=0.5), stiffness=1.0, name="c")
        )
        scene.add(nc.BodyForceInput((nc.Point(ball), normal[1]), name="push"))
        system, state = scene.compile()
        assert np.allclose(state.v[0], (1.0, 0.0, 0.0), atol=1e-12)
        assert float(system.sense(state, "c").gap) == pytest.approx(-0.1, abs=1e-12)
        pushed, rest = (system.instant(state, inputs=[u]).accelerations for u in (1.0, 0.0))
        row = 4 * system.body_index("ball")
        assert np.allclose((pushed - rest)[row], (0, 0, 1.0), atol=1e-12)


@pytest.mark.exhaustive
def test_a_ball_rolls_down_a_plane_whatever_the_length_of_its_normal():
    """Gap and motion: from rest 5/7 of what slides, at its height, without slip or loss."""
    for size in (1.0, 2.0, 0.5):
        scene = nc.Scene()
        scene.add(nc.Gravity(vector=(1.0, 0.0, -9.81)))
        sphere = {"shape": nc.Sphere(0.1), "density": 1e3}
        ball = scene.add(nc.RigidBody(**sphere, position=(0, 0, 0.1), name="ball"))
        normal = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, size))
        scene.add(nc.Rolling((*normal, nc.Point(ball)), radius=0.1))
        near = scene.add(nc.RigidBody(**sphere, position=(3, 0, 0.15), name="near"))
        scene.add(nc.Contact(near, nc.Plane(normal=(0, 0, size)), stiffness=1e3, name="contact"))
        system, state = scene.compile()
        assert float(system.sense(state, "contact").gap) == pytest.approx(0.05, abs=1e-14)
        run = nc.simulate(system, state, dt=0.01, steps=100)
        moved = system.sense(run, "ball")
        assert np.allclose(moved.position[-1], (2.5 / 7, 0, 0.1), rtol=0, atol=1e-6), size
        assert abs(moved.velocity[-1, 0] - 0.1 * moved.angular_velocity[-1, 1]) <= 1e-10
        assert nc.balance(system, run).energy.max() <= tol.STEP_BALANCE


def above_its_plane():
    """A ball that is to roll, a fifth of its radius above the plane."""
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(shape=nc.Sphere(0.5), density=1.0, position=(0, 0, 0.6)))
    table = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
    scene.add(nc.Rolling((*table, nc.Point(ball)), radius=0.5, name="roll"))
    return scene


def test_a_ball_rolls_on_its_plane():
    """One that starts above it would go on rolling there."""
    with pytest.raises(ValueError, match="'roll' by 0.1 m"):
        above_its_plane().compile()


@pytest.mark.slow
def test_a_ball_is_put_on_its_plane():
    state = above_its_plane().compile(assemble=True)[1]
    assert float(state.q[0, 2]) == pytest.approx(0.5, abs=1e-12)
