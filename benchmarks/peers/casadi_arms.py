"""Cart-pole and an arm with seven axes by CasADi and IPOPT: joint coordinates, the implicit midpoint rule.

As a command, `python -m benchmarks.peers.casadi_arms panda 40` waits for lines, see `asked`. States and
inputs of all steps are unknowns; the start is a straight line between the postures, at rest, without torques.
"""

import math
import sys
import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from benchmarks.peers import panda
from benchmarks.peers.asked import serve

CART, POLE, LENGTH, GRAVITY = 1.0, 0.3, 0.5, 9.81
"""Masses [kg], length [m] and gravity [m/s2] of the cart-pole."""


def _about_x(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _about_z(angle: Any) -> Any:
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))


def arm_torques(q: Any, v: Any, a: Any) -> Any:
    """Inverse dynamics of the arm by the recursion of Newton and Euler, in the axes of the links."""
    spin, turning, acceleration = ca.DM.zeros(3), ca.DM.zeros(3), ca.DM([0, 0, panda.GRAVITY])
    links = []
    for k, ((mass, com, inertia), (length, offset, twist)) in enumerate(zip(panda.LINKS, panda.FRAMES)):
        place = np.array([length, -math.sin(twist) * offset, math.cos(twist) * offset])
        turn = ca.mtimes(ca.DM(_about_x(twist)), _about_z(q[k]))
        at = acceleration + ca.cross(turning, place) + ca.cross(spin, ca.cross(spin, place))
        spin, turning, acceleration = turn.T @ spin, turn.T @ turning, turn.T @ at
        axis = ca.vertcat(0, 0, v[k])
        turning = turning + ca.vertcat(0, 0, a[k]) + ca.cross(spin, axis)
        spin = spin + axis
        centre, own = ca.DM(com), ca.DM(np.diag(inertia))
        force = mass * (acceleration + ca.cross(turning, centre) + ca.cross(spin, ca.cross(spin, centre)))
        moment = own @ turning + ca.cross(spin, own @ spin) + ca.cross(centre, force)
        links.append((turn, place, force, moment))
    force, moment, torques = ca.DM.zeros(3), ca.DM.zeros(3), [None] * len(links)
    after: Any = None
    for k in reversed(range(len(links))):
        turn, place, own_force, own_moment = links[k]
        if after is not None:
            force_before = after[0] @ force
            moment = after[0] @ moment + ca.cross(ca.DM(after[1]), force_before)
            force = force_before
        force, moment = force + own_force, moment + own_moment
        torques[k] = moment[2]
        after = turn, place
    return ca.vertcat(*torques)


def cart_torques(q: Any, v: Any, a: Any) -> Any:
    """Forces of the cart-pole: the equations of M. Kelly, SIAM Review 59 (2017) 849-904, section 6."""
    s, c = ca.sin(q[1]), ca.cos(q[1])
    first = (CART + POLE) * a[0] + POLE * LENGTH * (c * a[1] - s * v[1] ** 2)
    second = POLE * LENGTH * (c * a[0] + LENGTH * a[1] + GRAVITY * s)
    return ca.vertcat(first, second)


class Problem:
    """A motion from rest to rest by least effort.

    Attributes:
        torques: inverse dynamics.
        start: coordinates.
        end: coordinates.
        limits: of the inputs, 0 where there is none.
        t_end: [s].
        widest: of coordinates.
        rates: weight of their squares.
    """

    def __init__(
        self,
        torques: Callable,
        start: Any,
        end: Any,
        limits: Any,
        t_end: float,
        widest: Any = None,
        rates: float = 0.0,
    ) -> None:
        self.torques, self.t_end, self.rates = torques, t_end, rates
        self.start, self.end, self.limits = (np.array(x, float) for x in (start, end, limits))
        self.widest = np.full(len(self.start), np.inf) if widest is None else np.array(widest, float)


PROBLEMS = {
    "cart_pole": Problem(cart_torques, (0, 0), (1, math.pi), (20, 0), 2.0, (2, np.inf)),
    "panda": Problem(arm_torques, panda.START, panda.END, panda.LIMITS, panda.T_END, None, panda.RATES),
}


def solver_of(problem: Problem, steps: int, settings: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """The solver, and what it is called with."""
    n, h = len(problem.start), problem.t_end / steps
    x, y, u = ca.SX.sym("x", 2 * n), ca.SX.sym("y", 2 * n), ca.SX.sym("u", n)
    middle, change = 0.5 * (x + y), (y - x) / h
    gaps = ca.vertcat(change[:n] - middle[n:], problem.torques(middle[:n], middle[n:], change[n:]) - u)
    step = ca.Function("step", [x, y, u], [gaps])
    X, U = ca.MX.sym("X", 2 * n, steps + 1), ca.MX.sym("U", n, steps)
    g = step.map(steps)(X[:, :-1], X[:, 1:], U)
    order = ca.vertcat(ca.vec(ca.vertcat(X[:, :-1], U)), X[:, -1])
    flat = ca.MX.sym("z", order.numel())
    block = ca.reshape(flat[: 3 * n * steps], 3 * n, steps)
    states = ca.horzcat(block[: 2 * n, :], flat[3 * n * steps :])
    cost = h * (ca.sumsqr(U) + problem.rates * ca.sumsqr(X[n:, :]))
    f, g = ca.graph_substitute([cost, ca.vec(g)], [X, U], [states, block[2 * n :, :]])
    high = np.repeat(np.r_[problem.widest, np.full(n, np.inf)][:, None], steps + 1, 1)
    low = -high
    ends = ((0, problem.start), (steps, problem.end))
    for k, q in ends:
        low[:, k] = high[:, k] = np.concatenate([q, np.zeros(n)])
    line = np.linspace(problem.start, problem.end, steps + 1).T
    states0 = np.concatenate([line, np.zeros((n, steps + 1))])
    limits = np.repeat(problem.limits[:, None], steps, 1)

    def vector(states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        return np.r_[np.concatenate([states[:, :-1], inputs]).ravel("F"), states[:, -1]]

    ipopt = {"print_level": 0, "sb": "yes", "tol": 1e-8, "linear_solver": "mumps"} | settings
    options = {"ipopt": ipopt, "print_time": False, "expand": True}
    given = {"x0": vector(states0, 0.0 * limits), "lbx": vector(low, -limits), "ubx": vector(high, limits)}
    return ca.nlpsol("solver", "ipopt", {"x": flat, "f": f, "g": g}, options), given | {"lbg": 0, "ubg": 0}


def main() -> None:
    """Wait for lines."""
    name, steps = sys.argv[1], int(sys.argv[2])
    begun = time.perf_counter()
    solver, given = solver_of(PROBLEMS[name], steps, {})

    def solve() -> dict[str, Any]:
        found = solver(**given)
        stats = solver.stats()
        return {
            "cost": float(found["f"]),
            "iterations": int(stats["iter_count"]),
            "outcome": stats["return_status"],
            "violation": float(ca.norm_inf(found["g"])),
        }

    serve(solve, {"peer": "CasADi", "version": ca.__version__, "setup_s": time.perf_counter() - begun})


if __name__ == "__main__":
    main()
