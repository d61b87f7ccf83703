"""Constraints that depend on each other, for ever or for a moment.

What could go wrong: which of the dependent rows is kept, or in which order they come, changes the motion;
reactions of no effect push along the free motion; in a singular position, where the rank drops, the
mechanism stops, jumps to another branch, or loses energy.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
import tolerances as tol
from accounts import account, rows
from motions import simulate

import natcoord_jax as nc
from natcoord_jax import gallery

pytestmark = pytest.mark.slow

ORDERS = pytest.mark.parametrize("order", [2, pytest.param(4, marks=pytest.mark.slow)])
STEP, STEPS = 0.01, 300


def parallelogram(
    bars: int = 2,
    *,
    stays: int = 0,
    pins: Sequence[int] | None = None,
    loops: type = nc.Revolute,
    speed: float = 1.0,
):
    """Uprights on the ground joined by bars at their tips: every bar after the first is redundant.

    Args:
        bars: bars, each between two neighbours.
        stays: rods from the ground's row of feet to the bars' row, parallel to the uprights: redundant.
        pins: order in which the loops are closed.
        loops: joint that closes them; a ball in a plane mechanism leaves out rows that were redundant.
        speed: of the tips [m/s].
    """
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, -9.81, 0.0)))
    z = (0.0, 0.0, 1.0)

    def rod(name, place, along, rate=0.0, velocity=(0.0, 0.0, 0.0)):
        along = np.asarray(along, float)
        part = nc.RigidBody(
            mass=1.0,
            inertia=np.array([0.01, 0.01, 0.01]) + (1 - np.abs(along)) / 12,
            com=0.5 * along,
            position=place,
            velocity=velocity,
            angular_velocity=(0.0, 0.0, rate),
            name=name,
        )
        return scene.add(part)

    uprights = [rod(f"upright {k}", (k, 0, 0), (0, 1, 0), rate=-speed) for k in range(bars + 1)]
    for k, upright in enumerate(uprights):
        scene.add(nc.Revolute(nc.ground, upright, (k, 0, 0), z, name=f"foot {k}"))
    rods = [rod(f"bar {k}", (k, 1, 0), (1, 0, 0), velocity=(speed, 0, 0)) for k in range(bars)]
    for k, bar in enumerate(rods):
        scene.add(nc.Revolute(uprights[k], bar, (k, 1, 0), z, name=f"left pin {k}"))
    for k in range(bars) if pins is None else pins:
        scene.add(loops(uprights[k + 1], rods[k], (k + 1, 1, 0), z, name=f"right pin {k}"))
    for k in range(stays):
        at = 0.25 + 0.5 * k
        scene.add(nc.Distance(nc.ground, rods[0], (at, 1, 0), parent_point=(at, 0, 0), name=f"stay {k}"))
    return scene.compile()


@cache
def motion(order: int, **options):
    """Rows by the name of the body, and the account."""
    system, state = parallelogram(**options)
    trajectory = simulate(system, state, order=order, dt=STEP, steps=STEPS, extra_substeps=STEPS)
    by_name = {name: rows(trajectory.q)[:, system.body_index(name)] for name in system.structure.bodies}
    return system, by_name, account(system, trajectory)


VARIANTS = {
    "reordered": dict(pins=(1, 0)),
    "removed": dict(loops=nc.Spherical),
    "added": dict(stays=2),
}


@pytest.mark.parametrize("variant", VARIANTS)
@ORDERS
def test_rows_added_removed_reordered(order, variant):
    """The parallelogram passes its flat positions, where it could fold; the motion is the same."""
    _, wanted, _ = motion(order)
    system, found, kept = motion(order, **VARIANTS[variant])
    assert system.structure.dofs == 1
    assert kept.turned >= np.pi / 2, "the flat position is not reached"
    assert kept.energy_error <= tol.ENERGY
    assert max(kept.directors, kept.joints) <= tol.CONSTRAINT
    apart = max(np.max(np.abs(found[name] - wanted[name])) for name in wanted)
    assert apart <= tol.SAME_TRAJECTORY


@pytest.mark.parametrize("bars", [1, 3])
@ORDERS
def test_rows_of_four_bars(order, bars):
    """However many loops there are, they move as one parallelogram with the mean mass of all."""
    system, found, kept = motion(order, bars=bars)
    assert system.structure.dofs == 1
    assert kept.energy_error <= tol.ENERGY
    upright = [found[f"upright {k}"][:, 1:] for k in range(bars + 1)]
    assert max(np.max(np.abs(x - upright[0])) for x in upright) <= tol.SAME_TRAJECTORY


@pytest.mark.parametrize("name", ["four_bar", "bricard"])
@ORDERS
def test_singular_positions_of_the_gallery(name, order):
    """Bricard's mechanism and the row of four-bars over ten seconds: nothing is lost on the way."""
    example = gallery.load(name)
    trajectory = simulate(
        example.system, example.state, order=order, dt=0.01, steps=1000, extra_substeps=1000
    )
    found = account(example.system, trajectory)
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY
    assert max(found.directors, found.joints) <= tol.CONSTRAINT
