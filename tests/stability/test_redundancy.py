"""Constraints that depend on each other, for ever or for a moment.

What could go wrong: which of the dependent rows is kept, or in which order they come, changes the motion;
reactions of no effect push along the free motion; in a singular position, where the rank drops, the
mechanism stops, jumps to another branch, or loses energy.
"""

from collections.abc import Callable
from functools import cache

import jax
import numpy as np
import pytest
import tolerances as tol
from accounts import account, rows
from motions import losses, orders, simulate

import natcoord_jax as nc
from natcoord_jax import gallery

STEP, STEPS = 0.01, 1000
FEW = 300
"""Steps for which two forms of a scene are compared: their roundings differ, and grow with the motion."""


def reordered(scene: nc.Scene) -> None:
    """Other joints close the loops, other bodies come first."""
    scene.joints = dict(reversed(scene.joints.items()))


def removed(scene: nc.Scene) -> None:
    """Without rows that follow from others: a ball does in a plane mechanism, a cardan joint in Bricard's."""
    for name, joint in scene.joints.items():
        bodies = joint.parent, joint.child
        if name.startswith("right pin"):
            scene.joints[name] = nc.Spherical(*bodies, point=joint.point, name=name)
        elif name == "hinge 6":
            second = np.roll(joint.axis, 1)
            scene.joints[name] = nc.Universal(
                *bodies, point=joint.point, axis=joint.axis, second=second, name=name
            )


def added(scene: nc.Scene) -> None:
    """With rods parallel to the uprights; with the rows of a hinge twice."""
    if "hinge 6" in scene.joints:
        last = scene.joints["hinge 6"]
        scene.add(nc.Cylindrical(last.parent, last.child, point=last.point, axis=last.axis, name="again"))
        return
    bar = scene.joints["left pin 0"].child
    for k in range(2):
        at = 0.25 + 0.5 * k
        stay = nc.Distance(nc.ground, bar, point=(at, 1, 0), parent_point=(at, 0, 0), name=f"stay {k}")
        scene.add(stay)


def extended(scene: nc.Scene) -> None:
    """Rows added, and all reordered."""
    added(scene)
    reordered(scene)


def load(name: str, change: Callable | None, **options) -> gallery.Example:
    """A scene of the gallery, changed before it is compiled."""

    class Changed(nc.Scene):
        def compile(self, **options):
            if change is not None:
                change(self)
            return super().compile(**options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nc, "Scene", Changed)
        return gallery.load(name, **options)


@cache
def motion(name: str, order: int, change: Callable | None = None, **options):
    """The system, rows by the name of the body, and the account, over ten seconds."""
    example = load(name, change, **options)
    system = example.system
    trajectory = simulate(system, example.state, order=order, dt=STEP, steps=STEPS, extra_substeps=STEPS)
    by_name = {body: rows(trajectory.q)[:, system.body_index(body)] for body in system.structure.bodies}
    return system, by_name, account(system, trajectory)


CHANGES = {
    ("four_bar", 2): (added, reordered, removed),
    ("bricard", 2): (removed, added, reordered),
    ("four_bar", 4): (added, reordered, removed),
    ("bricard", 4): (extended,),
}
LANES = {("bricard", 2, removed): pytest.mark.slow}


@pytest.mark.parametrize(
    ("name", "order", "change"),
    [
        pytest.param(*case, change, marks=LANES.get((*case, change), pytest.mark.exhaustive))
        for case, changes in CHANGES.items()
        for change in changes
    ],
)
def test_rows_added_removed_reordered(name, order, change):
    """The same motion, though the row of four-bars passes its flat positions, where it could fold."""
    _, wanted, _ = motion(name, order)
    system, moved, laws = motion(name, order, change)
    assert system.structure.dofs == 1
    assert not losses(laws, turned=np.pi / 2), "or the flat position is not reached"
    apart = max(np.max(np.abs(moved[body][:FEW] - wanted[body][:FEW])) for body in wanted)
    assert apart <= tol.SAME_TRAJECTORY


def scissors(cells: int) -> nc.Scene:
    """Crossed ideal rods on top of each other: one foot hinged to the ground, the other on a slider."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    wide, high, rod = 2.0 * np.cos(0.6), 2.0 * np.sin(0.6), {"mass": 1.0, "inertia": (0.0, 0.34, 0.34)}
    slider = scene.add(nc.RigidBody(mass=0.2, inertia=(0.01,) * 3, position=(wide, 0, 0), name="slider"))
    scene.add(nc.Prismatic(nc.ground, slider, point=(wide, 0, 0), axis=(1, 0, 0), name="rail"))
    below = nc.ground, slider
    for k in range(cells):
        middle = 0.5 * wide, 0.0, (k + 0.5) * high
        rods = [scene.add(nc.RigidBody(**rod, position=middle, name=f"rod {k} {n}")) for n in range(2)]
        scene.add(nc.Revolute(*rods, point=middle, axis=(0, 1, 0), name=f"cross {k}"))
        for n in range(2):
            at = n * wide, 0.0, k * high
            scene.add(nc.Revolute(below[n], rods[n], point=at, axis=(0, 1, 0), name=f"foot {k} {n}"))
        below = rods[::-1]
    return scene


FRAMES = {
    "four-bars": (lambda count: gallery.load("four_bar", bars=count), (1, 2, 4, 6, 8, 12, 16, 32)),
    "scissors": (lambda count: scissors(count).compile(), (2, 5, 10, 20)),
}


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        pytest.param(
            kind,
            count,
            marks=pytest.mark.exhaustive,
        )
        for kind, (_, counts) in FRAMES.items()
        for count in counts
    ],
)
def test_frames_of_many_dependent_loops(kind, count):
    """Whatever form of the equations the size chooses: one degree of freedom, errors of round-off."""
    example = FRAMES[kind][0](count)
    system, state = (example.system, example.state) if kind == "four-bars" else example
    assert system.structure.dofs == 1
    for dt in (1e-4, 1e-3, 1e-2):
        run = simulate(system, state, dt=dt, steps=150)
        assert float(np.max(system.constraint_errors(run).joints)) <= 1e-12, dt
        assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE, dt
        assert int(np.sum(run.iterations)) <= 6 * 150, dt


@pytest.mark.exhaustive
@pytest.mark.parametrize("bars", [2, 4, 8])
def test_rows_of_four_bars_whichever_the_solver(bars):
    """Each form of the equations has the motion of the others, in few corrections."""
    places = []
    for solver in ("reduced", "full", "sparse"):

        class Solved(nc.Scene):
            def compile(self, solver=solver, **options):
                return super().compile(solver=solver, **options)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(nc, "Scene", Solved)
            example = gallery.load("four_bar", bars=bars)
        system = example.system
        run = simulate(system, example.state, dt=1e-3, steps=150)
        assert float(np.max(system.constraint_errors(run).joints)) <= 1e-12, solver
        assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE, solver
        assert int(np.sum(run.iterations)) <= 2 * 150, solver
        places.append(np.asarray(run.q))
    for other in places[1:]:
        np.testing.assert_allclose(other, places[0], atol=tol.SAME_TRAJECTORY)


@pytest.mark.exhaustive
@pytest.mark.parametrize("count", [2, 4])
def test_six_rates_a_body_and_dependent_loops(count):
    """Ideal rods have no inertia about their axes, and what rounding leaves of it is none."""
    scene, places = scissors(count), []
    for solver in ("full", "reduced"):
        system, state = scene.compile(solver=solver)
        run = simulate(system, state, dt=1e-3, steps=150)
        assert float(np.max(system.constraint_errors(run).joints)) <= 1e-12
        places.append(np.asarray(system.sense(run, f"rod {count - 1} 0").position))
    assert np.max(np.abs(places[0] - places[1])) <= tol.SAME_TRAJECTORY


@pytest.mark.exhaustive
@pytest.mark.parametrize("bars", [1, 3])
@pytest.mark.parametrize("order", [2, 4])
def test_rows_of_four_bars(order, bars):
    """However many loops there are, they move as one parallelogram with the mean mass of all."""
    system, moved, laws = motion("four_bar", order, bars=bars)
    assert system.structure.dofs == 1
    assert laws.energy_error <= tol.ENERGY
    upright = [moved[f"upright {k}"][:, 1:] for k in range(bars + 1)]
    apart = np.max([np.max(np.abs(x - upright[0]), axis=(1, 2)) for x in upright], axis=0)
    # Where the row is flat, lengths of its bars do not see how uprights turn: rounding counts as the inverse
    # of the distance from there, and a step may end as near to it as chance will have it.
    from_flat = np.abs(upright[0][:, 1, 1])
    assert np.min(from_flat) <= 0.05
    assert np.max(apart * from_flat) <= tol.ALONG_THE_ROW


@orders(second="slow")
def test_the_singular_position_is_passed(order):
    """The row of four-bars goes through its flat position again and again; its bars never turn, as they would
    where it folds."""
    system, moved, laws = motion("four_bar", order)
    assert system.structure.dofs == 1
    along = moved["upright 0"][:, 2]
    angle = np.unwrap(np.arctan2(along[:, 0], along[:, 1]))
    flat = np.floor(angle / np.pi - 0.5)  # counts the positions at odd multiples of pi / 2
    assert np.sum(np.diff(flat) != 0) >= 8, "the flat positions are not passed"
    for bar in ("bar 0", "bar 1"):
        assert np.max(np.abs(moved[bar][:, 1:] - moved[bar][0, 1:])) <= tol.SAME_TRAJECTORY
    assert not losses(laws)


@pytest.mark.parametrize(
    "order",
    [
        pytest.param(2, marks=pytest.mark.slow),
        pytest.param(4, marks=pytest.mark.exhaustive),
        pytest.param(6, marks=pytest.mark.exhaustive),
    ],
)
def test_bricard_over_ten_seconds(order):
    """It stays on the branch of the reference, and nothing is lost on the way."""
    _, moved, laws = motion("bricard", order)
    assert not losses(laws)
    for t, place in gallery.load("bricard").facts["corner 3"].items():
        error = np.max(np.abs(moved["rod 4"][round(t / STEP), 0] - place))
        assert error <= tol.ERRORS_OF_BRICARD[order], (t, error)


def pair(size, again):
    """Two bodies on a ball joint that fly; `again`: with a constraint that repeats it."""
    scene, bodies = nc.Scene(), []
    for k in range(2):
        place, turned = size * np.array([0.5 * k, 0.3 * k, -1.0]), ((1, 2, 2), 0.7 * k)
        numbers = {"mass": 1.5, "inertia": size**2 * np.array([0.2, 0.25, 0.3]), "orientation": turned}
        numbers["com"] = size * np.array([0.05, -0.03, 0.1])
        moving = {"angular_velocity": (0.5 - 2.0 * k, 0.4, 0.7), "velocity": (0.3 * k * size, 0, 0)}
        bodies.append(scene.add(nc.RigidBody(**numbers, **moving, position=place, name=f"{k}")))
    place = size * np.array([0.2, 0.1, -1.3])
    scene.add(nc.Spherical(*bodies, point=place))
    if again:
        ends = tuple(nc.Point(body, place) for body in (*bodies, bodies[0]))
        scene.add(nc.PointSum(ends, weights=(0.7, -1.0, 0.3), name="again"))
    return scene.compile(assemble=True)


@pytest.mark.slow
@pytest.mark.parametrize("size", [pytest.param(x, marks=pytest.mark.exhaustive) for x in (1e-6, 1e4)] + [1.0])
def test_what_only_repeats_a_joint_is_none(size):
    """All that is left of it beside the joint is rounding, which has a rank of its own."""
    runs = []
    for again in (False, True):
        system, state = pair(size, again)
        assert system.structure.dofs == 9
        runs.append(nc.simulate(system, state, dt=0.1, steps=20))
    assert any("again" in name for name in system.structure.redundant)
    assert int(runs[1].steps_rejected) == 0
    apart = np.abs(np.asarray(runs[1].q - runs[0].q))
    apart[:, ::4] /= size
    assert apart.max() <= tol.SAME_SOLUTION


def parallelogram(mass):
    """A plane loop that stands askew in space, so that what follows from others does so but for rounding."""
    scene, axes = nc.Scene(), np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    scene.add(nc.Gravity())
    bar, ends = {"mass": mass, "inertia": (0.1, 0.1, 0.1)}, np.eye(3)[[0, 2]] @ axes
    bars = [scene.add(nc.RigidBody(**bar, com=(0.1, 0, 0.5), position=x)) for x in (0 * ends[0], ends[0])]
    coupler = scene.add(nc.RigidBody(**bar, position=ends[1]))
    for k, one in enumerate(bars):
        scene.add(nc.Revolute(nc.ground, one, point=k * ends[0], axis=axes[1]))
        scene.add(nc.Revolute(one, coupler, point=k * ends[0] + ends[1], axis=axes[1]))
    return scene.compile()


@pytest.mark.slow
@pytest.mark.parametrize(
    "build", [parallelogram, pytest.param(lambda _: pair(1.0, True), marks=pytest.mark.exhaustive)]
)
def test_scenes_that_are_built_inside_of_jit_move_alike(build):
    """Which of their constraints depend on others is not known before they run."""

    def place(mass):
        system, state = build(mass)
        run = nc.simulate(system, state, dt=0.02, steps=30)
        return run.q[-1], run.result

    built, result = jax.jit(place)(1.5)
    assert int(result) == 0
    np.testing.assert_allclose(built, place(1.5)[0], rtol=0, atol=tol.SAME_SOLUTION)


@pytest.mark.exhaustive
def test_scenes_that_are_built_inside_of_jit_have_derivatives():
    """Of their motion by what they are built of."""

    @jax.jit
    def place(mass):
        system, state = parallelogram(mass)
        return nc.simulate(system, state, dt=0.02, steps=30).q[-1]

    slope = jax.jit(jax.jacfwd(place))(1.5)
    difference = (place(1.5 + 1e-4) - place(1.5 - 1e-4)) / 2e-4
    np.testing.assert_allclose(slope, difference, rtol=0, atol=1e-6 * np.max(np.abs(slope)))
