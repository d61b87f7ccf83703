"""Wrong problems of optimal control: each is refused by name, most before anything is compiled.

The table of docs/howto/control_wrong_problems.md has a row for each, with a part of what is said.
"""

import math
import re
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc

PAGE = Path(__file__).resolve().parents[1] / "docs" / "howto" / "control_wrong_problems.md"
COORDINATE, RATE, REST, AT = nc.goal.Coordinate, nc.goal.Rate, nc.goal.Rest, nc.goal.At
NAN = math.nan


def driven(joint: Any = nc.Revolute, motor: Any = nc.JointTorque, **options):
    """A disc, or a cart, with a motor."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0), name="disc"))
    hinge = scene.add(joint(nc.ground, body, name="hinge"))
    if motor is not None:
        scene.add(motor(hinge, name="motor", **options))
    return scene.compile()


@pytest.fixture(scope="module")
def disc():
    return driven()


def problem(scene, **options):
    """A turn by 1 rad in a second."""
    fields = {"dt": 0.1, "steps": 10, "cost": nc.cost.Effort(), "goal": COORDINATE("hinge", 1.0) & REST()}
    return nc.OptimalControl(*scene, **(fields | options))


def solved(scene, guess=None, **options):
    return nc.optimise(problem(scene, **options), guess, progress=False)


def nowhere(scene):
    """The scene with a state whose velocities are no numbers."""
    system, state = scene
    return system, eqx.tree_at(lambda s: s.v, state, state.v * NAN)


def running(function):
    return nc.cost.Effort() + nc.cost.Running(function)


def other_scene():
    """A scene of two bodies."""
    scene = nc.Scene()
    for name in ("disc", "more"):
        body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name=name))
        scene.add(nc.Revolute(nc.ground, body, name=f"hinge of {name}"))
    return scene.compile()


# What is wrong, by the names of the rows of the page.
WRONG = {
    "two values of one coordinate": lambda s: problem(
        s, goal=COORDINATE("hinge", 1.0) & COORDINATE("hinge", 2.0)
    ),
    "two values at one waypoint": lambda s: problem(
        s, goal=AT(COORDINATE("hinge", 1.0), step=5) & AT(COORDINATE("hinge", 2.0), step=5)
    ),
    "two attitudes": lambda s: problem(
        s, goal=nc.goal.Attitude("disc", (1, 0, 0, 0)) & nc.goal.Attitude("disc", (0, 0, 0, 1))
    ),
    "at rest and moving": lambda s: problem(s, goal=RATE("hinge", 1.0) & REST()),
    "a goal outside of the bounds": lambda s: problem(
        s, bounds=nc.bounds.Coordinate(-0.5, 0.5, joint="hinge")
    ),
    "a waypoint after the end": lambda s: problem(s, goal=AT(REST(), step=11)),
    "an unknown joint": lambda s: problem(s, goal=COORDINATE("hing", 1.0)),
    "an unknown body": lambda s: problem(s, goal=nc.goal.Position("disk", (0, 0, 0))),
    "a parameter of nothing": lambda s: problem(s, parameters=(nc.Parameter("motr.gear"),)),
    "no second coordinate": lambda s: problem(s, goal=COORDINATE("hinge", 1.0, index=1)),
    "no number in the state": lambda s: problem(nowhere(s)),
    "the state of another scene": lambda s: problem((s[0], other_scene()[1])),
    "no number in a goal": lambda s: problem(s, goal=COORDINATE("hinge", NAN)),
    "no number in a bound": lambda s: problem(s, bounds=nc.bounds.Input(NAN, 1.0)),
    "no number in a weight": lambda s: problem(s, cost=nc.cost.Effort(NAN)),
    "no number in a guess": lambda s: solved(s, np.full((10, 1), NAN)),
    "no number in the cost": lambda s: solved(s, cost=running(lambda state, u, t: jnp.log(-1.0 - u[0] ** 2))),
    "no slope of the cost": lambda s: solved(
        s, cost=running(lambda state, u, t: jnp.sqrt(jnp.abs(state.coordinates[0])))
    ),
    "no number in a path bound": lambda s: solved(
        s, bounds=nc.bounds.Path(lambda state, u, t: jnp.log(state.coordinates[0] - 1.0), "room")
    ),
    "a negative weight": lambda s: problem(s, cost=nc.cost.Effort(-1.0)),
    "weights of other channels": lambda s: problem(s, cost=nc.cost.Effort((1.0, 2.0))),
    "limits of other channels": lambda s: problem(s, bounds=nc.bounds.Input((-1.0, -1.0), 1.0)),
    "limits the wrong way round": lambda s: problem(s, bounds=nc.bounds.Input(1.0, -1.0)),
    "a negative step": lambda s: problem(s, dt=-0.1),
    "a step for some": lambda s: problem(s, dt=(0.1, 0.2, 0.3)),
    "no steps": lambda s: problem(s, steps=0),
    "a time the wrong way round": lambda s: problem(s, free_time=(2.0, 1.0)),
    "a negative time": lambda s: problem(s, free_time=(-2.0, 1.0)),
    "least time without limits": lambda s: problem(s, cost=nc.cost.Duration(), free_time=True),
    "a guess of other steps": lambda s: solved(s, np.zeros((9, 1))),
    "rates of another system": lambda s: solved(s, nc.Guess(rates=np.zeros((10, 2)))),
    "values of what is not free": lambda s: solved(s, nc.Guess(free=(1.0,))),
    "a cost that returns nothing": lambda s: problem(s, cost=running(lambda state, u, t: None)),
    "a cost that returns several": lambda s: problem(s, cost=running(lambda state, u, t: jnp.ones(2))),
    "a cost of other arguments": lambda s: problem(s, cost=running(lambda state, u: u[0])),
    "no input": lambda s: problem(driven(motor=None)),
    "a motor without a gear": lambda s: solved(driven(gear=0.0)),
    "a torque on a slide": lambda s: solved(driven(nc.Prismatic)),
}
# What starts outside of bounds is an outcome; it is found as early.
LATER = {"a start outside of the bounds"}


def said(page: Path) -> dict[str, str]:
    """The rows of the page: what is wrong, and a part of what is said."""
    rows = re.findall(r"^\| ([^|`]+) \| `([^`]+)` \|", page.read_text("utf-8"), re.MULTILINE)
    return {name.strip(): part for name, part in rows}


ROWS = said(PAGE)


def test_the_page_has_a_row_for_each():
    assert ROWS.keys() == WRONG.keys() | LATER and len(ROWS) > 30


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_problem_is_refused_as_the_page_says(disc, name):
    with pytest.raises((ValueError, TypeError)) as refused:
        WRONG[name](disc)
    assert ROWS[name] in str(refused.value), str(refused.value)


def test_a_start_outside_of_the_bounds_is_told_before_anything_is_compiled(disc):
    found = solved(disc, bounds=nc.bounds.Coordinate(0.5, 2.0, joint="hinge"))
    assert found.outcome is nc.Outcome.INFEASIBLE_START and not found.history
    assert ROWS["a start outside of the bounds"] in found.explain()


def test_what_is_asked_for_twice_or_elsewhere_is_no_contradiction(disc):
    twice = COORDINATE("hinge", 1.0) & COORDINATE("hinge", 1.0) & REST() & RATE("hinge", 0.0)
    problem(disc, goal=twice & AT(COORDINATE("hinge", 2.0) & RATE("hinge", 1.0), step=5))
    # A quaternion and its negative are the same attitude.
    problem(disc, goal=nc.goal.Attitude("disc", (1, 0, 0, 0)) & nc.goal.Attitude("disc", (-1, 0, 0, 0)))
    # An input that acts where something moves, and not at rest, is an input.
    problem(disc, cost=nc.cost.Duration(), free_time=(0.5, 2.0))


@pytest.mark.exhaustive
def test_a_time_that_grows_without_end_and_limits_that_do_not_do_are_told(disc):
    found = solved(disc, free_time=True)
    assert "final time [s] has grown from 1 to" in found.note and "nc.cost.Duration()" in found.explain()
    # It takes 4 I / T^2 = 3.6 N m.
    lost = solved(disc, dt=0.15, bounds=nc.bounds.Input(-0.3, 0.3))
    assert lost.outcome is nc.Outcome.UNREACHABLE
    words = r"reaching the goal in 1.5 s needs input 'motor' from -([\d.]+) to .*; the limits are -0.3 to 0.3"
    needed = re.search(words, lost.reason)
    assert needed is not None and 3.6 <= float(needed[1]) <= 5.0, lost.reason
