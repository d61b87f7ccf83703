"""The table of the laws: joint by form by scheme, with the lane of each entry."""

from functools import cache
from typing import Any

import jax
import numpy as np
import pytest
from scenes import JOINTS, pair, with_multipliers

import natcoord_jax as nc

VARIATIONAL = nc.VariationalMidpoint()
DISSIPATIVE = nc.Dissipative(spectral_radius=0.5)
ORDERS = (2, 4, 6, 8, 10)
SCHEMES: dict[str, Any] = {
    **{f"order {order}": nc.EnergyMomentum(order=order) for order in ORDERS},
    "order 2 with kicks": nc.EnergyMomentum(kick=True),
    "variational": VARIATIONAL,
    "dissipative": DISSIPATIVE,
}
"""Each with a row in every table of the laws; `test_schemes` holds that none is missing."""

FORMS = ("tree", "multipliers")
MOST = 1000
"""Steps that there is room for, in all runs of a scene: one program serves them."""


def lane(case: Any, default: set, slow: set) -> Any:
    """An entry of a table, a tuple of names, marked by its lane."""
    marks = [] if case in default else [pytest.mark.slow if case in slow else pytest.mark.exhaustive]
    return pytest.param(*case, marks=marks, id="-".join(map(str, case)))


@cache
def kind(joint: str, form: str) -> type:
    """One class a joint and form: what is compiled goes by it."""
    return JOINTS[joint] if form == "tree" else with_multipliers(JOINTS[joint])


@cache
def compiled(joint: str, form: str, free: bool) -> tuple[Any, Any]:
    """Two bodies on a joint, hung by a spring under gravity, or free in space; springs are inside."""
    return pair(kind(joint, form), **({"gravity": 0.0, "hanging": 0.0} if free else {}))


def run(system: Any, state: Any, dt: float, steps: int, scheme: Any) -> Any:
    """A run in the program of all runs of the scene; states after the last step repeat it."""
    room = nc.Steps(steps, MOST)
    result = nc.simulate(system, state, dt=dt, steps=room, scheme=scheme, extra_substeps=3 * MOST)
    # Numbers of NumPy are cut without a program for every shape.
    return jax.tree.map(np.asarray, result)


def in_order(system: Any, rows: Any, bodies: Any) -> np.ndarray:
    """Rows (..., bodies, 4, 3) of bodies by name: forms of the equations place them in other orders."""
    rows = np.asarray(rows)
    places = [system.body_index(body) for body in bodies]
    return rows.reshape(*rows.shape[:-2], -1, 4, 3)[..., places, :, :]
