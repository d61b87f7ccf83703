"""Boxes on boxes: what impacts keep, edges that cross, what stands and slides, derivatives, wrong input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc

FLOOR = nc.Plane(normal=(0, 0, 1))
TURNS = {
    "flat": ((0, 0, 1), 0.3),
    "edge": ((1, 0, 0), np.pi / 4),
    "corner": ((1, 1, 0), 0.9),
}
LAWS = {
    "soft": {"stiffness": 2e4},
    "hard": {"restitution": 1.0},
    # Of a smaller radius edges overlap by two of them, and touch where their distance has no direction.
    "soft with friction": {"stiffness": 2e4, "friction": 0.3, "rounding": 0.02},
    "hard with friction": {"restitution": 0.5, "friction": 0.3},
}
RESTS = {"restitution": 0.0, "friction": 0.5}


def falling(turn, law):
    """A box in space on its way to another one that moves as well."""
    scene = nc.Scene()
    given = {"shape": nc.Box((0.4, 0.3, 0.1)), "velocity": (0, 0, 0.3), "angular_velocity": (0.2, 0.1, 0.5)}
    table = scene.add(nc.RigidBody(density=500.0, **given))
    given = {"shape": nc.Box((0.2, 0.1, 0.15)), "position": (0.03, 0.02, 0.25), "velocity": (0.1, 0, -1.0)}
    brick = scene.add(nc.RigidBody(density=500.0, orientation=turn, **given))
    scene.add(nc.Contact(table, brick, name="impact", **law))
    return *scene.compile(), brick


@pytest.mark.slow
@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize(
    "law",
    ["soft", "hard", "hard with friction", pytest.param("soft with friction", marks=pytest.mark.exhaustive)],
)
def test_a_box_falls_on_a_box(turn, law):
    """Energy but for what is booked, momentum and angular momentum, on a face, an edge and a corner."""
    system, state, brick = falling(TURNS[turn], LAWS[law])
    trajectory = nc.simulate(system, state, dt=2e-3, steps=200)
    found = nc.balance(system, trajectory)
    assert found.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert found.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert found.angular_momentum.max() <= 10 * tol.MOMENTUM_OF_A_SMALL_SCENE
    energy = np.asarray(system.energy(trajectory).total)
    assert np.diff(energy).max() <= 1e-13
    gaps = nc.contacts(system, trajectory).gap
    # By the compliance with which they share a load.
    assert gaps.min() >= (-1e-10 if "hard" in law else -0.02)
    assert np.asarray(system.sense(trajectory, brick).velocity)[-1, 2] > 0.1


def crossing(law, rounding=0.01):
    """Two long boxes that are turned by half a right angle about their axes, which cross: edge to edge."""
    scene = nc.Scene()
    along = nc.RigidBody(shape=nc.Box((1.0, 0.1, 0.1)), density=500.0, orientation=((1, 0, 0), np.pi / 4))
    given = {"position": (0, 0, 0.2), "velocity": (0, 0, -2.0), "orientation": ((0, 1, 0), np.pi / 4)}
    one = scene.add(along)
    other = scene.add(nc.RigidBody(shape=nc.Box((0.1, 1.0, 0.1)), density=500.0, **given))
    scene.add(nc.Contact(one, other, name="edges", rounding=rounding, **law))
    return *scene.compile(), other


@pytest.mark.parametrize("law", ["soft", pytest.param("hard", marks=pytest.mark.slow)])
def test_crossing_edges_do_not_pass(law):
    """No corner is near: edges meet where they are round, and all of the speed passes on."""
    system, state, other = crossing({"stiffness": 1e6} if law == "soft" else LAWS[law])
    trajectory = nc.simulate(system, state, dt=1e-3, steps=100)
    assert nc.balance(system, trajectory).energy.max() <= 10 * tol.ENERGY_OF_A_SMALL_SCENE
    gap = nc.contacts(system, trajectory).gap.min(axis=1)
    assert gap[0] == pytest.approx(0.2 - 2 * (np.sqrt(2) * (0.05 - 0.01) + 0.01), abs=1e-9)
    assert gap[-1] > 0.05
    last = np.asarray(system.sense(trajectory, other).velocity)[-1]
    np.testing.assert_allclose(last, 0.0, atol=1e-5)


def on_top(sizes, places, law=RESTS, **last):
    """Boxes on the floor and on each other."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    below = FLOOR
    for k, (size, place) in enumerate(zip(sizes, places)):
        moving = last if k == len(sizes) - 1 else {}
        box = scene.add(nc.RigidBody(shape=nc.Box(size), density=500.0, position=place, **moving))
        scene.add(nc.Contact(box, below, **law))
        below = box
    return *scene.compile(), below


STACKS = {
    "aligned": ([(0.2,) * 3] * 2, [(0, 0, 0.1), (0, 0, 0.3)], {}),
    "overhanging": ([(0.2,) * 3] * 2, [(0, 0, 0.1), (0.05, 0, 0.3)], {}),
    "turned": ([(0.2,) * 3] * 2, [(0, 0, 0.1), (0, 0, 0.3)], {"orientation": ((0, 0, 1), np.pi / 4)}),
    "crossed": ([(1.0, 0.2, 0.1), (0.2, 1.0, 0.1)], [(0, 0, 0.05), (0, 0, 0.15)], {}),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "stack",
    [
        "overhanging",
        "crossed",
        *(pytest.param(name, marks=pytest.mark.exhaustive) for name in ("aligned", "turned")),
    ],
)
def test_boxes_on_boxes_stand(stack):
    """On corners, on edges that cross, and on both: for two seconds nothing moves by more than rounding."""
    sizes, places, last = STACKS[stack]
    system, state, _ = on_top(sizes, places, **last)
    trajectory = nc.simulate(system, state, dt=5e-3, steps=400)
    assert np.abs(np.asarray(trajectory.q) - np.asarray(state.q)).max() <= 1e-9
    assert int(trajectory.steps_rejected) == 0


@pytest.mark.exhaustive
def test_a_stack_of_ten_boxes_stands():
    """For ten seconds, each on the one below, which it meets at its own corners and at those of the other.

    With a tenth of the compliance that they have, which of them carry the load changes from step to step,
    and the eighth ends the run.
    """
    system, state, _ = on_top([(0.2,) * 3] * 10, [(0, 0, 0.1 + 0.2 * k) for k in range(10)])
    trajectory = nc.simulate(system, state, dt=5e-3, steps=2000)
    assert np.abs(np.asarray(trajectory.q) - np.asarray(state.q)).max() <= 1e-9
    assert int(trajectory.steps_rejected) == 0


@pytest.mark.slow
def test_a_box_slides_on_a_box():
    """It stops after v^2 / (2 mu g), on a heavy one that it hardly moves."""
    sizes, places = [(1.0, 0.6, 0.2), (0.1, 0.1, 0.05)], [(0, 0, 0.1), (-0.2, 0, 0.225)]
    law = {"restitution": 0.0, "friction": 0.4}
    system, state, box = on_top(sizes, places, law, velocity=(1.0, 0, 0))
    trajectory = nc.simulate(system, state, dt=5e-3, steps=80)
    moved = np.asarray(system.sense(trajectory, box).position)[-1, 0] + 0.2
    assert moved == pytest.approx(1.0 / (2 * 0.4 * 9.81), abs=1e-4)
    assert np.abs(np.asarray(trajectory.v)[-1]).max() <= 1e-9


@pytest.mark.slow
def test_derivatives_through_an_impact_of_edges():
    """Of where boxes fly, by the speed and by the rounding of their edges."""
    system, state, _ = crossing({"stiffness": 1e5})

    def end(x):
        faster = eqx.tree_at(lambda s: s.v, state, state.v.at[4, 2].add(x[0]))
        rounder = system
        for k in range(8, 12):
            rounder = rounder.set(f"edges[{k}]", rounding=0.01 + x[1])
        return nc.simulate(rounder, faster, dt=2e-3, steps=60, throw=False).q[-1, 4]

    x, along = jnp.zeros(2), jnp.array([0.6, 1e-3])
    assert_v_shaped(end, x, along, jax.jvp(end, (x,), (along,))[1])


@pytest.mark.parametrize(
    ("shapes", "given", "message"),
    [
        ([nc.Box((1, 1, 0.1))] * 2, {"rounding": 0.05}, r"rounding \[m\] is 0.05, but .* as short as 0.1 m"),
        (
            [nc.Sphere(0.1), nc.Box((1, 1, 1))],
            {"rounding": 0.01},
            "rounding is an option of the edges of two boxes; leave",
        ),
    ],
)
def test_rounding_that_is_refused(shapes, given, message):
    scene = nc.Scene()
    one, other = (scene.add(nc.RigidBody(shape=shape, density=1.0)) for shape in shapes)
    with pytest.raises(ValueError, match=message):
        scene.add(nc.Contact(one, other, **given))
    with pytest.raises(ValueError, match="size"):
        nc.Box((1.0, 0.0, 1.0))


def test_a_capsule_falls_across_an_edge():
    """Neither of its ends is above the box: an edge holds it, and energy and momenta are kept."""
    scene = nc.Scene()
    box = scene.add(
        nc.RigidBody(shape=nc.Box((0.3, 0.3, 0.3)), density=500.0, orientation=((0, 1, 0), np.pi / 4))
    )
    given = {"position": (0, 0.05, 0.3), "velocity": (0, 0, -2.0), "orientation": ((0, 1, 0), np.pi / 2)}
    rod = scene.add(nc.RigidBody(shape=nc.Capsule(radius=0.03, length=1.0), density=500.0, **given))
    scene.add(nc.Contact(box, rod, stiffness=2e4))
    system, state = scene.compile()
    gaps = nc.contacts(system, trajectory := nc.simulate(system, state, dt=1e-3, steps=100)).gap
    assert gaps[0].min() == pytest.approx(0.3 - 0.15 * np.sqrt(2) - 0.03, rel=1e-3)
    assert -0.03 < gaps.min() < 0 < gaps[-1].min()
    found = nc.balance(system, trajectory)
    # While the contact is closed, places that are rounded to 1e-14 m are worth that times the force.
    assert found.energy.max() <= 1e-11 and found.energy[-1] <= 10 * tol.ENERGY_OF_A_SMALL_SCENE
    assert found.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert found.angular_momentum.max() <= 10 * tol.MOMENTUM_OF_A_SMALL_SCENE
