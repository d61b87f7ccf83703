"""Bad input: one ValueError each, naming the part, the quantity with its unit, and the remedy."""

import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.core.results import Result, SimulationError

ROOT = Path(__file__).resolve().parents[1]
REMEDY = r"(pass|use|add|check|give|move|declare|make|allow|clamp)\b"


def body(**changes):
    return nc.RigidBody(**({"mass": 1.0, "inertia": (1.0, 1.0, 1.0), "name": "arm"} | changes))


def refusal(action, *words: str) -> str:
    """What is wrong with how an action is refused: a ValueError with all the words and a remedy is not."""
    try:
        action()
    except ValueError as error:
        message = str(error)
        missing = [word for word in words if word not in message]
        missing += [] if re.search(REMEDY, message) else ["a remedy"]
        return f"{missing} missing in: {message}" if missing else ""
    except Exception as error:
        return f"raises {error!r}, no ValueError"
    return "is accepted"


def rejected(action, *words: str) -> None:
    """The action raises a ValueError with all the words and a remedy."""
    wrong = refusal(action, *words)
    assert not wrong, wrong


def all_rejected(cases) -> None:
    """The same for many actions: by a name of the case, the action and its words."""
    refusals = {case: refusal(action, *words) for case, (action, *words) in cases.items()}
    wrong = [f"{case}: {reason}" for case, reason in refusals.items() if reason]
    assert not wrong, "\n".join(wrong)


# --- bodies -----------------------------------------------------------------------------------------------

BODIES = {
    "zero mass": (dict(mass=0.0), "mass", "[kg]"),
    "negative mass": (dict(mass=-1.0), "mass", "[kg]"),
    "mass not finite": (dict(mass=np.nan), "mass", "[kg]"),
    "mass of wrong shape": (dict(mass=(1.0, 2.0)), "mass", "[kg]"),
    "triangle inequality": (dict(inertia=(1.0, 1.0, 3.0)), "inertia", "kg m^2"),
    "negative inertia": (dict(inertia=(-1.0, 1.0, 1.0)), "inertia", "kg m^2"),
    "no inertia": (dict(inertia=(0.0, 0.0, 0.0)), "inertia", "kg m^2"),
    "unsymmetric inertia": (dict(inertia=((1, 0.5, 0), (0, 1, 0), (0, 0, 1))), "inertia", "[kg m^2]"),
    "inertia not finite": (dict(inertia=(1.0, np.inf, 1.0)), "inertia", "[kg m^2]"),
    "inertia at the wrong point": (
        dict(inertia=(1.0, 1.0, 1.0), com=(0.0, 0.0, 5.0), inertia_at="reference"), "inertia", "kg m^2"
    ),
    "inertia at nowhere": (dict(inertia_at="tip"), "inertia_at"),
    "negative second moment": (dict(inertia=None, second_moment=(1.0, -1.0, 1.0)), "second_moment", "kg m^2"),
    "no inertia given": (dict(inertia=None), "inertia", "kg m^2"),
    "no mass given": (dict(mass=None), "mass", "kg"),
    "shape and mass": (dict(shape=nc.Box((1.0, 1.0, 1.0)), density=1.0), "mass", "density"),
    "shape without density": (
        dict(mass=None, inertia=None, shape=nc.Box((1.0, 1.0, 1.0))), "density", "kg/m^3"
    ),
    "position not finite": (dict(position=(0.0, np.nan, 0.0)), "position", "[m]"),
    "position of wrong shape": (dict(position=(0.0, 0.0)), "position", "[m]"),
    "position no numbers": (dict(position="here"), "position", "[m]"),
    "velocity not finite": (dict(velocity=(0.0, np.inf, 0.0)), "velocity", "[m/s]"),
    "angular velocity of wrong shape": (dict(angular_velocity=1.0), "angular_velocity", "[rad/s]"),
    "com not finite": (dict(com=(np.nan, 0.0, 0.0)), "com", "[m]"),
    "no rotation": (dict(orientation=2 * np.eye(3)), "orientation", "[-]"),
    "reflection": (dict(orientation=np.diag([1.0, 1.0, -1.0])), "orientation", "[-]"),
    "zero quaternion": (dict(orientation=(0.0, 0.0, 0.0, 0.0)), "orientation", "[-]"),
    "zero axis": (dict(orientation=((0.0, 0.0, 0.0), 1.0)), "orientation", "[-]"),
}  # fmt: skip


def test_bodies():
    all_rejected(
        {case: (partial(body, **changes), "'arm'", *words) for case, (changes, *words) in BODIES.items()}
    )


def test_point_mass():
    rejected(lambda: nc.PointMass(mass=-2.0, name="ball"), "'ball'", "mass", "[kg]")


# --- scenes and joints ------------------------------------------------------------------------------------


def test_joint_of_a_body_with_itself():
    scene = nc.Scene()
    arm = scene.add(body())
    rejected(lambda: scene.add(nc.Revolute(arm, arm, name="hinge")), "'hinge'", "'arm'")


def test_body_of_another_scene():
    arm = nc.Scene().add(body())
    scene = nc.Scene()
    other = scene.add(body(name="other"))
    rejected(lambda: scene.add(nc.Revolute(other, arm, name="hinge")), "'hinge'", "'arm'")
    spring = nc.Spring((nc.Point(other), nc.Point(arm)), name="coil", stiffness=1.0)
    rejected(lambda: scene.add(spring), "'coil'", "'arm'")


def test_joint_of_another_scene():
    other = nc.Scene()
    hinge = other.add(nc.Revolute(nc.ground, other.add(body()), name="hinge"))
    scene = nc.Scene()
    scene.add(body(name="here"))
    rejected(lambda: scene.add(nc.JointTorque(hinge, name="motor")), "'motor'", "'hinge'")


def test_duplicate_names():
    scene = nc.Scene()
    arm = scene.add(body())
    rejected(lambda: scene.add(body()), "'arm'", "name")
    rejected(lambda: scene.add(nc.Revolute(nc.ground, arm, name="arm")), "'arm'", "name")
    rejected(lambda: scene.add(body(name="ground")), "'ground'", "name")


def test_things_that_are_no_parts():
    scene = nc.Scene()
    arm = scene.add(body())
    hinge = scene.add(nc.Revolute(nc.ground, arm, name="hinge"))
    rejected(lambda: scene.add(nc.Revolute(hinge, arm, name="other")), "'other'", "'hinge'")
    rejected(lambda: scene.add(nc.Revolute(nc.ground, "arm", name="third")), "'third'")


JOINTS = {
    "zero axis": (dict(axis=(0.0, 0.0, 0.0)), "axis", "[-]"),
    "axis of wrong shape": (dict(axis=(1.0, 0.0)), "axis", "[-]"),
    "axis not finite": (dict(axis=(1.0, np.nan, 0.0)), "axis", "[-]"),
    "point not finite": (dict(point=(1.0, np.nan, 0.0)), "point", "[m]"),
    "point of wrong shape": (dict(point=1.0), "point", "[m]"),
    "second along the axis": (dict(axis=(0.0, 0.0, 2.0), second=(0.0, 0.0, 1.0)), "second", "[-]"),
}


def test_joints():
    def build(changes):
        scene = nc.Scene()
        scene.add(nc.Revolute(nc.ground, scene.add(body()), name="hinge", **changes))

    all_rejected(
        {case: (partial(build, changes), "'hinge'", *words) for case, (changes, *words) in JOINTS.items()}
    )


def test_coordinates_that_a_joint_does_not_have():
    scene = nc.Scene()
    hinge = scene.add(nc.Revolute(nc.ground, scene.add(body()), name="hinge"))
    scene.add(nc.JointSpring(hinge, stiffness=1.0, coordinate=1, name="coil"))
    with pytest.raises(ValueError, match=r"'coil'.*'hinge'.*1 coordinate"):
        scene.compile()


def test_what_there_is_for_joints_without_coordinates_is_named():
    """A ball turns freely, about no axis of its own; a fixed joint does not move."""

    def build(joint, effect):
        scene = nc.Scene()
        place = scene.add(joint(nc.ground, scene.add(body()), name="place"))
        scene.add(effect(place))
        scene.compile()

    spring, damper = partial(nc.JointSpring, stiffness=1.0), partial(nc.JointDamper, damping=1.0)
    servo = lambda joint: nc.AffineActuator((joint,))  # noqa: E731
    all_rejected(
        {
            "spring": (partial(build, nc.Spherical, spring), "'place'", "nc.SphericalSpring"),
            "damper": (partial(build, nc.Spherical, damper), "'place'", "nc.SphericalDamper"),
            "motor": (partial(build, nc.Spherical, nc.JointForce), "'place'", "nc.SphericalTorque"),
            "servo": (partial(build, nc.Spherical, servo), "'place'", "nc.SphericalTorque"),
            "fixed": (partial(build, nc.Fixed, spring), "'place'", "pass another joint"),
        }
    )


NUMBERS = {
    "stiffness": (lambda p, j: nc.Spring(p, name="part", stiffness=np.nan), "stiffness", "[N/m]"),
    "coil": (lambda p, j: nc.JointSpring(j, stiffness=np.inf, name="part"), "stiffness"),
    "damping": (lambda p, j: nc.Damper(p, name="part", damping=np.nan), "damping", "[N s/m]"),
    "gravity": (lambda p, j: nc.Gravity(vector=(0.0, np.nan, 0.0), name="part"), "vector", "[m/s^2]"),
    "force": (lambda p, j: nc.PointForce(p[:1], name="part", force=(np.inf, 0.0, 0.0)), "force", "[N]"),
    "armature": (lambda p, j: nc.Armature(j, inertia=np.nan, name="part"), "inertia"),
}


def test_numbers_of_effects_must_be_finite():
    def build(make):
        scene = nc.Scene()
        arm = scene.add(body())
        hinge = scene.add(nc.Revolute(nc.ground, arm, name="hinge"))
        scene.add(make((nc.Point(nc.ground, (1.0, 0.0, 0.0)), nc.Point(arm)), hinge))
        scene.compile()

    all_rejected({case: (partial(build, make), "'part'", *words) for case, (make, *words) in NUMBERS.items()})


WRONG_MARKERS = {
    "spring to a direction": (lambda p, d: nc.Spring((p, d), stiffness=1.0), "2 nc.Point"),
    "spring of one point": (lambda p, d: nc.NonlinearSpring((p,), law=jnp.square), "2 nc.Point"),
    "quadratic spring of a body": (lambda p, d: nc.QuadraticSpring((p, p.body), stiffness=1.0), "2 nc.Point"),
    "damper of three points": (lambda p, d: nc.Damper((p, p, p), damping=1.0), "2 nc.Point"),
    "thruster without direction": (lambda p, d: nc.BodyForceInput((p,)), "1 nc.Point and 1 nc.Direction"),
    "torques about one axis": (lambda p, d: nc.BodyTorqueInput((d,)), "3 nc.Direction"),
}


def test_markers_must_be_of_the_kind_that_an_effect_needs():
    markers = nc.Point(nc.ground), nc.Direction(nc.ground, (0.0, 0.0, 1.0))
    all_rejected(
        {
            case: (partial(make, *markers), f"pass {words}, in a tuple")
            for case, (make, words) in WRONG_MARKERS.items()
        }
    )


def test_empty_scene():
    rejected(lambda: nc.Scene().compile(), "bodies")


def test_gap_is_refused_with_its_size():
    scene = nc.Scene()
    arm = scene.add(body(position=(0.0, 0.0, 1.0)))
    rod = nc.Distance(nc.ground, arm, point=(0.0, 0.0, 1.0), length=0.75, name="rod")
    scene.add(rod)
    rejected(scene.compile, "'rod'", " m")
    state = scene.compile(assemble=True)[1]
    assert float(jnp.linalg.norm(state.q[0])) == pytest.approx(0.75)


def test_velocities_are_projected_with_a_warning():
    scene = nc.Scene()
    arm = scene.add(body(com=(0.0, 0.0, 1.0), velocity=(1.0, 0.0, 0.0)))
    scene.add(nc.Revolute(nc.ground, arm, point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0), name="hinge"))
    with pytest.warns(UserWarning, match=r"m/s"):
        system, state = scene.compile()
    assert float(system.constraint_errors(state).velocity) <= 1e-12


def test_a_scene_compiled_inside_jit_starts_as_outside():
    """There is no telling: velocities are projected without a word, and a joint that gapes makes NaN."""

    def built(length, speed):
        scene = nc.Scene()
        arm = scene.add(body(position=(0.6, 0.0, 0.8), velocity=(speed, 0.1, 0.0)))
        scene.add(nc.Distance(nc.ground, arm, point=(0.6, 0.0, 0.8), length=length, name="rod"))
        return scene.compile()[1]

    inside = jax.jit(built)
    with pytest.warns(UserWarning, match="projected"):
        wanted = built(1.0, 1.0)
    for state in (inside(1.0, 1.0), jax.jit(jax.vmap(built))(jnp.array([1.0]), jnp.array([1.0]))):
        np.testing.assert_allclose(state.v.reshape(wanted.v.shape), wanted.v, atol=1e-12)
    assert np.all(np.isnan(inside(1.5, 1.0).q))
    # Derivatives are those of the projection: it takes part of the speed away, and the rest turns the arm.
    step = 1e-6
    differences = (inside(1.0, 1.0 + step).v - inside(1.0, 1.0 - step).v) / (2 * step)
    slopes = jax.jit(jax.jacrev(lambda speed: built(1.0, speed).v))(1.0)
    np.testing.assert_allclose(slopes, differences, atol=1e-8)
    assert 0 < float(jnp.max(jnp.abs(slopes)))


def test_ideal_rod_that_spins_freely():
    scene = nc.Scene()
    rod = scene.add(body(inertia=(1.0, 1.0, 0.0), name="rod"))
    scene.add(nc.Spherical(nc.ground, rod, point=(0.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match=r"inertia \[kg m\^2\]"):
        scene.compile()


# --- running ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pendulum():
    scene = nc.Scene()
    scene.add(nc.Gravity())
    arm = scene.add(body(com=(0.3, 0.0, 0.0)))
    hinge = scene.add(nc.Revolute(nc.ground, arm, point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


def test_steps_must_be_positive(pendulum):
    calls = {"simulate": partial(nc.simulate, *pendulum, steps=2), "step": partial(nc.step, *pendulum)}
    all_rejected(
        {
            f"{name} with dt = {dt}": (partial(call, dt=dt), "dt", "[s]")
            for name, call in calls.items()
            for dt in (0.0, -0.1, np.nan, np.inf)
        }
    )


def test_inputs_of_wrong_shape(pendulum):
    call = partial(nc.simulate, *pendulum, dt=0.1)
    all_rejected(
        {
            f"inputs of shape {shape}": (partial(call, inputs=jnp.zeros(shape)), "inputs", "shape", "motor")
            for shape in ((3,), (3, 2), (4, 3, 1), (0, 1))
        }
    )


def test_other_bad_arguments(pendulum):
    rejected(lambda: nc.simulate(*pendulum, dt=0.1), "steps")
    rejected(lambda: nc.simulate(*pendulum, dt=0.1, steps=0), "steps")
    rejected(lambda: nc.simulate(*pendulum, dt=0.1, steps=3, inputs=jnp.zeros((2, 1))), "inputs")
    rejected(lambda: nc.simulate(*pendulum, dt=0.1, steps=3, save_every=2), "save_every")
    rejected(lambda: nc.simulate(*pendulum, dt=0.1, inputs=jnp.full((2, 1), jnp.nan)), "inputs", "[N, N m]")
    rejected(lambda: nc.simulate(*pendulum, dt=jnp.ones(3), steps=3), "dt", "[s]")
    system, state = pendulum
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    rejected(lambda: nc.simulate(system, batch, dt=0.1, steps=3), "state", "shape")


def test_unknown_names(pendulum):
    system, _ = pendulum
    for ask in (system.body_index, system.joint_index, system.input_index):
        with pytest.raises(ValueError, match="'nothing'"):
            ask("nothing")


def test_single_precision_unasked():
    """The message holds the line to add."""
    program = (
        "import natcoord_jax as nc\n"
        "for make in (nc.Scene, lambda: nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0))):\n"
        "    try:\n"
        "        make()\n"
        "    except ValueError as error:\n"
        "        assert 'jax.config.update(\"jax_enable_x64\", True)' in str(error), error\n"
        "    else:\n"
        "        raise SystemExit('accepted')\n"
    )
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr + run.stdout


# --- inside a run: result codes, never a silent NaN -------------------------------------------------------


class Breaking(nc.Force):
    """A force [N] that is undefined after a time [s]."""

    def load(self, x, rate, inputs, t):
        """The root of the time left."""
        return nc.Load(jnp.sqrt(0.24 - t) * jnp.ones_like(x), None)


@pytest.fixture(scope="module")
def breaking():
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, name="ball"))
    scene.add(Breaking((nc.Point(ball),), name="breaking"))
    return scene.compile()


def test_undefined_force_is_reported(breaking):
    with pytest.raises(SimulationError, match=r"step 2 at t = 0.2.*'ball'") as caught:
        nc.simulate(*breaking, dt=0.1, steps=10)
    assert caught.value.result is Result.NONFINITE
    trajectory = caught.value.trajectory
    assert bool(jnp.all(jnp.isfinite(trajectory.q))), "what was computed must be sound, the last state held"
    assert int(trajectory.failed_step) == 2


def test_nothing_is_raised_inside_transformations(breaking):
    """Codes travel; a failed lane does not touch the others."""
    system, state = breaking
    runs = jax.vmap(lambda dt: nc.simulate(system, state, dt=dt, steps=10))(jnp.array([0.01, 0.1]))
    assert list(np.asarray(runs.result)) == [int(Result.SUCCESSFUL), int(Result.NONFINITE)]
    assert bool(jnp.all(jnp.isfinite(runs.q)))
    alone = nc.simulate(system, state, dt=0.01, steps=10)
    assert np.allclose(runs.q[0], alone.q, atol=1e-14)
    inside = jax.jit(lambda dt: nc.simulate(system, state, dt=dt, steps=10).result)(0.1)
    assert int(inside) == int(Result.NONFINITE)
    words = system.explain(runs)
    assert "lane 1" in words and "'ball'" in words and "t = 0.2" in words


@pytest.mark.exhaustive
def test_nothing_is_raised_inside_derivatives(pendulum):
    """Outside of programs the code is known there, what was computed is not."""
    system, state = pendulum

    def height(dt):
        run = nc.simulate(system, state, dt=dt, steps=5, extra_substeps=0)
        return run.q[-1, 0, 2], run.result

    with pytest.raises(SimulationError, match="more substeps"):
        height(10.0)
    slope, result = jax.grad(height, has_aux=True)(10.0)
    assert bool(jnp.isfinite(slope)) and int(result) == int(Result.MAX_SUBSTEPS)
    jax.jvp(lambda dt: height(dt)[0], (10.0,), (1.0,))
    scene = nc.Scene()
    scene.add(nc.Gravity())
    scene.add(nc.PointMass(mass=1.0, name="falling"))
    falling = scene.compile()
    with pytest.raises(SimulationError, match="no equilibrium"):
        nc.equilibrium(*falling, loads=1.0)
    jax.grad(lambda load: nc.equilibrium(*falling, loads=load).state.q.sum())(1.0)


def test_traced_step_that_is_not_positive(breaking):
    system, state = breaking
    result = jax.jit(lambda dt: nc.simulate(system, state, dt=dt, steps=2).result)(-0.1)
    assert int(result) == int(Result.BAD_STEP)


@pytest.mark.slow
def test_traced_starts_that_violate_a_loop_or_a_contact():
    """What eager calls refuse is a code in a program: the lane ends at its start, and the others go on."""
    example = gallery.load("four_bar")
    system, state = example.system, example.state

    def run(off):
        moved = eqx.tree_at(lambda s: s.q, state, state.q.at[4, 2].add(off))
        return nc.simulate(system, moved, dt=example.dt, steps=3)

    runs = jax.vmap(run)(jnp.array([0.0, 1e-8, 1e-3]))
    assert list(np.asarray(runs.result)) == [0, 0, int(Result.BAD_START)]
    assert np.array_equal(runs.q[2], np.broadcast_to(runs.q[2, 0], runs.q[2].shape))
    assert re.search(
        r"violate.*joint 'foot 1' by 0.001 m.*lane 2 in step 0.*nc.assemble", system.explain(runs)
    )
    with pytest.raises(nc.SimulationError, match="start violate.*nc.assemble"):
        nc.step(system, eqx.tree_at(lambda s: s.q, state, state.q.at[4, 2].add(1e-3)), dt=example.dt)

    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(shape=nc.Sphere(0.1), density=1.0, position=(0, 0, 1)))
    scene.add(nc.Contact(ball, nc.Plane(normal=(0, 0, 1)), restitution=1.0, name="floor"))
    system, state = scene.compile()
    low = jnp.array([0, 0, -1.0]) * jnp.array([1.0, 0, 0, 0])[:, None]
    sunk = jax.jit(
        lambda: nc.simulate(system, eqx.tree_at(lambda s: s.q, state, state.q + low), dt=0.1, steps=1)
    )
    trajectory = sunk()
    assert int(trajectory.result) == int(Result.BAD_START)
    assert "'floor" in system.explain(trajectory) and "0.1 m" in system.explain(trajectory)


# --- effects of one's own ---------------------------------------------------------------------------------


class Pin(nc.Joint):
    """Slides along the first axis and turns about the third: not the same with parent and child exchanged."""

    multipliers, rotations, translations, free = 4, (2,), (0,), True

    def residual(self, parent, child):
        u, third = child.point - parent.point, child.axes[2]
        return jnp.stack(
            [parent.axes[1] @ u, parent.axes[2] @ u, parent.axes[0] @ third, parent.axes[1] @ third]
        )


DESCRIBED = {
    "pin in a slot": {},
    "ball in a slot": {"rotations": (0, 1, 2), "translations": (2,), "multipliers": 2},
    "two rotations": {"rotations": (0, 1), "translations": ()},
    "too few multipliers": {"rotations": (2,), "translations": (2,), "multipliers": 3},
}


def test_free_motions_that_the_tree_does_not_know():
    cases = {}
    for case, described in DESCRIBED.items():
        scene = nc.Scene()
        joint = type("Own", (Pin,), described)
        scene.add(joint(nc.ground, scene.add(body()), name="pin"))
        cases[case] = scene.compile, "'pin'", "free = False", "Own"
    all_rejected(cases)


class OwnJoint(nc.Joint):
    multipliers = 1

    def residual(self, parent, child):
        return parent.axes[2] @ (child.point - parent.point)


class Bowl(nc.Joint):
    multipliers = 1

    def residual(self, parent, child):
        x, y, z = parent.axes @ (child.point - parent.point)
        return ((x**2 + y**2) / 2 - z)[None]


def test_joints_of_nodes_that_carry_no_axes():
    """Asked of a node is what the constraints are made of, no more; where that is missing it is refused."""
    at = {"mass": 1.0, "position": (0.3, 0.0, 0.045), "name": "ball"}

    def joined(joint, point=None, swapped=False):
        scene = nc.Scene()
        ball = scene.add(nc.PointMass(**at))
        pair = (ball, nc.ground) if swapped else (nc.ground, ball)
        scene.add(joint(*pair, point=point, name="own"))
        return scene.compile()

    bowl = type("Bowl", (Bowl,), {"anchors": lambda self: ((0.0, 0.0, 0.0), self.point)})
    system, state = joined(bowl)
    trajectory = nc.simulate(system, state, dt=1e-2, steps=20)
    assert np.abs(system.constraint_errors(trajectory).position).max() < 1e-12
    rejected(
        lambda: joined(Bowl, swapped=True), "'own'", "'ball' has a point only", "a Bowl joint could hold"
    )
    rejected(lambda: joined(bowl, (0.3, 0.0, 0.0)), "'own'", "'ball' has a point only", "0.045 m beside it")


class Length(nc.Gap):
    """Of a point from another one, and no square of it."""

    def invariants(self, x):
        return jnp.sqrt((x[1] - x[0]) @ (x[1] - x[0]))[None]

    def distance(self, invariants):
        return invariants[0] - 0.1


class Stretch(nc.Potential):
    def invariants(self, x):
        return Length().invariants(x)

    def energy(self, invariants):
        return invariants[0] ** 2


class Sphere(nc.Constraint):
    multipliers = 1

    def residual(self, x):
        return Length().invariants(x) - 1.0


def test_what_is_not_quadratic_is_refused():
    """A bowl that moves is of degree four; what the ground carries is a number."""

    def build(make, parent=None):
        scene = nc.Scene()
        first = scene.add(body(position=(1.0, 0.0, 0.0)))
        second = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="second"))
        scene.add(make(parent or first, second))
        scene.compile(assemble=True)

    def between(kind, *more, **options):
        return lambda a, b: kind((nc.Point(a), nc.Point(b)), *more, name="own", **options)

    apart = type("Bowl", (Bowl,), {"apart": True})
    gap = Length(), "Length.invariants"
    cases = {
        "joint": (lambda a, b: apart(a, b, name="own"), "Bowl.residual"),
        "constraint": (between(Sphere), "Sphere.residual"),
        "potential": (between(Stretch), "Stretch.invariants"),
        "soft gap": (between(nc.GapPotential, gap[0], stiffness=1.0), gap[1]),
        "hard gap": (between(nc.GapConstraint, gap[0]), gap[1]),
    }
    all_rejected(
        {case: (partial(build, make), "'own'", words, "quadratic") for case, (make, words) in cases.items()}
    )
    build(lambda a, b: apart(a, b, name="own"), nc.ground)


class OwnConstraint(nc.Constraint):
    def residual(self, x):
        return (x[1] @ x[1] - x[0] @ x[0] - 1.0)[None]


class OwnPotential(nc.Potential):
    def invariants(self, x):
        return (x[1] - x[0]) @ (x[1] - x[0])

    def energy(self, invariants):
        return invariants


class OwnEnergy(OwnPotential):
    def invariants(self, x):
        return super().invariants(x)[None]


class OwnForce(nc.Force):
    def load(self, x, rate, inputs, t):
        return nc.Load(-rate[0], None)


OWN = {
    "joint": (lambda a, ends: OwnJoint(nc.ground, a), "OwnJoint.residual", "value[None]"),
    "constraint": (lambda a, ends: OwnConstraint(ends), "OwnConstraint.residual", "multipliers = 1"),
    "invariants": (lambda a, ends: OwnPotential(ends), "OwnPotential.invariants", "value[None]"),
    "energy": (lambda a, ends: OwnEnergy(ends), "OwnEnergy.energy", "(1,)"),
    "force": (lambda a, ends: OwnForce(ends), "OwnForce.load", "(2, 3)"),
}


def test_shapes_that_effects_of_ones_own_return():
    def take_a_step(make):
        scene = nc.Scene()
        arm = scene.add(body())
        scene.add(make(arm, (nc.Point(nc.ground), nc.Point(arm, (1.0, 0.0, 0.0)))))
        nc.step(*scene.compile(), dt=0.1)

    all_rejected({case: (partial(take_a_step, make), *words) for case, (make, *words) in OWN.items()})


def test_functions_of_inputs_give_as_many_as_there_are():
    """Of another number one would drive several motors, or be left out."""
    scene = nc.Scene()
    arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
    hinge = scene.add(nc.Revolute(nc.ground, arm, point=(0, 0, 0), axis=(0, 0, 1)))
    scene.add(nc.JointTorque(hinge, name="motor"))
    system, state = scene.compile()
    call = partial(nc.simulate, system, state, dt=0.1, steps=1)

    def constant(values):
        return lambda t, state: values

    cases = {
        f"inputs that give {values}": (
            partial(call, inputs=constant(values)),
            "inputs gives shape",
            "['motor']",
            "give shape (1,)",
        )
        for values in (jnp.ones(2), 1.0, jnp.ones(0))
    }
    cases["inputs of time"] = partial(call, inputs=lambda t: 1.0), "takes other arguments; pass", "(t, state)"
    cases["until of nothing"] = (
        partial(call, until=lambda: 0.0),
        "takes other arguments; pass",
        "of the state",
    )
    all_rejected(cases)


def test_names_that_are_nearly_right_are_told():
    with pytest.raises(AttributeError, match="no attribute 'RevoluteJoint'; did you mean Revolute?"):
        _ = nc.RevoluteJoint  # pyright: ignore[reportAttributeAccessIssue]
    scene = nc.Scene()
    box = scene.add(nc.RigidBody(shape=nc.Box((1, 1, 1)), density=1.0, position=(0, 0, 2)))
    scene.add(nc.Contact(box, nc.Plane(), name="hit"))
    system, state = scene.compile()
    with pytest.raises(ValueError, match=r"'hit' is 8 effects, 'hit\[0\]' to 'hit\[7\]'"):
        system.sense(state, "hit")
