"""Optimal control by CasADi and IPOPT: the spacecraft turned by its wheels, and the cart-pole.

As a command, `python -m benchmarks.peers.casadi_control reorientation 100 model=minimal` prints JSON.

The spacecraft has no momentum, so that its base follows from its wheels. Two discrete problems:

- "minimal": quaternion of the base and axial momenta of the wheels. Momenta change by h u, the mean of those
  before and after gives the mean angular velocity, Cayley's rotation by half of it per step turns the base.
- "directors": exactly the equations of natcoord_jax, (57), in as few unknowns as they allow. Velocities
  of directors go on by v_1 = 2 V - v_0, and v_0 is not a rigid velocity; so besides the quaternion those of
  three directors of the base and of the two transverse ones of each wheel are states, in axes of the base. A
  wheel is symmetric; its directors are taken anew along the base's axes in every step.

The cart-pole (Kelly 2017, trapezoidal collocation or Hermite-Simpson) is for the costs of that literature.
"""

import contextlib
import json
import math
import statistics
import sys
import tempfile
import time
from typing import Any

import casadi as ca
import numpy as np

from benchmarks.peers import spacecraft
from benchmarks.peers.asked import serve

# Masses [kg], diagonals of E [kg m2], places [m]: table 1 of the paper.
EULER = [0.5 * sum(b["inertia"]) - np.array(b["inertia"]) for b in spacecraft.BODIES]
MASSES = np.array([b["mass"] for b in spacecraft.BODIES])
PLACES = np.array([b["com"] for b in spacecraft.BODIES])
OTHERS = ((1, 2), (2, 0), (0, 1))
"""Transverse axes of the wheels."""


def _skew(a: Any) -> Any:
    return ca.skew(a)


def _middle(a: Any) -> Any:
    """(1 - a^)^-1: directors in the middle of a step from those at its start."""
    return (ca.DM.eye(3) + _skew(a) + a @ a.T) / (1 + ca.dot(a, a))


def _turned(q: Any, a: Any) -> Any:
    """Quaternion q (1, a): Cayley's rotation, normalised."""
    w, v = q[0], q[1:]
    turned = ca.vertcat(w - ca.dot(v, a), v + w * a + ca.cross(v, a))
    return turned / ca.sqrt(1 + ca.dot(a, a))


def _second_moment() -> np.ndarray:
    """Of all masses about their centre, without what turns with the wheels."""
    own = np.diag(EULER[0] + np.array([EULER[k + 1][k] for k in range(3)]))
    about = PLACES - MASSES @ PLACES / MASSES.sum()
    return own + np.einsum("b,bi,bj->ij", MASSES, about, about)


def _minimal(h: float) -> tuple[Any, int, int]:
    """Function of a step, (state, input, unknowns) -> (state, residual, momenta); sizes; q comes first."""
    moment = _second_moment() + sum(
        EULER[k + 1][j] * np.outer(e, e) for k in range(3) for j, e in _transverse(k)
    )
    inertia = np.trace(moment) * np.eye(3) - moment
    axial = np.diag([2 * EULER[k + 1][OTHERS[k][0]] for k in range(3)])
    flexibility = np.linalg.inv(inertia - axial)
    x, u, y = ca.SX.sym("x", 7), ca.SX.sym("u", 3), ca.SX.sym("y", 0)
    after = x[4:] + h * u
    a = -0.5 * h * ca.DM(flexibility) @ (0.5 * (x[4:] + after))
    return ca.Function("step", [x, u, y], [ca.vertcat(_turned(x[:4], a), after), ca.SX(0, 1), after]), 7, 0


def _transverse(k: int) -> list[tuple[int, np.ndarray]]:
    return [(j, np.eye(3)[j]) for j in OTHERS[k]]


def _directors(h: float) -> tuple[Any, int, int]:
    """As `_minimal`: state (q, W of the base 9, W of the wheels 6 each), unknowns (half turns, spins)."""
    x, u, y = ca.SX.sym("x", 31), ca.SX.sym("u", 3), ca.SX.sym("y", 6)
    q, own = x[:4], ca.reshape(x[4:13], 3, 3)
    a, spins = y[:3], y[3:]
    eye, moment = ca.DM.eye(3), ca.DM(_second_moment())
    middle = _middle(a)
    turn = 2 * middle - eye
    rate = 2 / h * (middle - eye)
    change = 2 * (rate - own) @ moment
    total = sum(ca.cross(middle[:, i], change[:, i]) for i in range(3))
    after = [_turned(q, a), ca.reshape(turn.T @ (2 * rate - own), 9, 1)]
    rows, momenta = [], []
    for k in range(3):
        t, moment = list(OTHERS[k]), float(EULER[k + 1][OTHERS[k][0]])
        w = ca.reshape(x[13 + 6 * k : 19 + 6 * k], 3, 2)
        axis = middle[:, k]
        wheel = _middle(a + spins[k] * axis)
        wheel_rate = 2 / h * (wheel - eye)[:, t]
        torque = sum(ca.cross(wheel[:, t[i]], 2 * moment * (wheel_rate - w)[:, i]) for i in range(2))
        total = total + torque
        rows.append(ca.dot(axis, torque) - h * u[k] * ca.dot(axis, axis))
        again = (2 * wheel - eye)[:, t].T @ turn[:, t]
        w1 = turn.T @ (2 * wheel_rate - w) @ again
        momenta.append(moment * (w1[t[1], 0] - w1[t[0], 1]))
        after.append(ca.reshape(w1, 6, 1))
    residual = ca.vertcat(total, *rows)
    return ca.Function("step", [x, u, y], [ca.vertcat(*after), residual, ca.vertcat(*momenta)]), 31, 6


MODELS = {"minimal": _minimal, "directors": _directors}


def _options(jit: bool) -> dict[str, Any]:
    ipopt = {
        "linear_solver": "mumps",
        "hessian_approximation": "exact",
        "tol": 1e-8,
        "print_level": 0,
        "sb": "yes",
    }
    found: dict[str, Any] = {"ipopt": ipopt, "print_time": False, "record_time": True}
    if jit:
        compiler = {"flags": ["-O2", "-march=native"], "verbose": False}
        found |= {"jit": True, "compiler": "shell", "jit_options": compiler}
    return found


def turning(
    steps: int,
    model: str = "minimal",
    transcription: str = "map",
    jit: bool = False,
    scaled: bool = True,
    limit: float = 200.0,
    t_end: float = 60.0,
    settings: dict[str, Any] | None = None,
) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """A solver for the spacecraft's turn by 90 degrees about (1, 2, -1) from inputs zero and rest.

    Args:
        steps: number of steps.
        model: "minimal" or "directors", see the module.
        transcription: "map" (one function of a step, mapped) or "unrolled" (one expression graph).
        jit: compile the functions with the C compiler.
        scaled: unknowns and equations in units of their typical sizes.
        limit: of the inputs [N m].
        t_end: [s].
        settings: more settings of IPOPT.

    Returns:
        The solver, what it is called with, and the seconds of its setup and number of unknowns.
    """
    begun = time.perf_counter()
    h = t_end / steps
    step, size, unknowns = MODELS[model](h)
    # Typical sizes: momenta and rates of a turn by 90 degrees in the middle of the manoeuvre.
    rate = 1.5 * (math.pi / 2) / t_end if scaled else 1.0
    state_scale = np.ones(size)
    state_scale[4:] = 500 * rate if model == "minimal" and scaled else 1.0
    if scaled and model == "directors":
        state_scale[4:13], state_scale[13:] = rate, 3 * rate
    unknown_scale = np.array([rate * h / 2] * 3 + [3 * rate * h / 2] * 3)[:unknowns]
    input_scale = np.full(3, 1.0)
    residual_scale = np.full(unknowns, h if scaled else 1.0)
    X, U, Y = ca.SX.sym("X", size, steps), ca.SX.sym("U", 3, steps), ca.SX.sym("Y", unknowns, steps)
    kind = ca.MX if transcription == "map" else ca.SX
    if transcription == "map":
        X, U, Y = (ca.MX.sym(n, *shape) for n, shape in (("X", X.shape), ("U", U.shape), ("Y", Y.shape)))
    start = np.zeros(size)
    start[0] = 1.0
    states = ca.horzcat(ca.DM(start), ca.mtimes(ca.diag(state_scale), X))
    inputs, others = input_scale[0] * U, ca.mtimes(ca.diag(unknown_scale), Y) if unknowns else kind(0, steps)
    called = step.map(steps) if transcription == "map" else step.map(steps, "unroll")
    after, residual, momenta = called(states[:, :-1], inputs, others)
    defects = ca.mtimes(ca.diag(1 / state_scale), states[:, 1:] - after)
    axis = np.array([1.0, 2.0, -1.0]) / math.sqrt(6)
    c, s = math.cos(math.pi / 4), math.sin(math.pi / 4) * axis
    end = states[:4, -1]
    missing = 2 * (c * end[1:] - s * end[0] + ca.cross(end[1:], ca.DM(s)))
    parts = [
        ca.vec(ca.vertcat(defects, ca.mtimes(ca.diag(1 / residual_scale), residual)) if unknowns else defects)
    ]
    g = ca.vertcat(*parts, missing, momenta[:, -1] / (500 * rate if scaled else 1.0))
    # Variables step by step, as the band of the equations wants them.
    order = ca.vec(ca.vertcat(U, Y, X))
    flat = ca.MX.sym("z", order.numel()) if kind is ca.MX else ca.SX.sym("z", order.numel())
    block = ca.reshape(flat, 3 + unknowns + size, steps)
    pieces = ca.vertsplit(block, [0, 3, 3 + unknowns, 3 + unknowns + size])
    f = h * ca.sumsqr(inputs)
    f, g = (
        ca.substitute([f, g], [U, Y, X], pieces)
        if kind is ca.SX
        else ca.graph_substitute([f, g], [U, Y, X], pieces)
    )
    options = _options(jit)
    options["ipopt"] |= settings or {}
    if kind is ca.MX:
        options["expand"] = not jit
    # The C compiler leaves its files in the working directory.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        solver = ca.nlpsol("solver", "ipopt", {"x": flat, "f": f, "g": g}, options)
    bound = np.full((3 + unknowns + size, steps), np.inf)
    bound[:3] = limit
    first = np.zeros((3 + unknowns + size, steps))
    first[3 + unknowns :] = (start / state_scale)[:, None]
    wide = bound.ravel("F")
    given = {"x0": first.ravel("F"), "lbx": -wide, "ubx": wide, "lbg": 0, "ubg": 0}
    return solver, given, {"setup_s": time.perf_counter() - begun, "variables": int(flat.numel())}


def reorientation(
    steps: int, *, repeats: int = 7, settings: dict[str, Any] | None = None, **chosen: Any
) -> dict[str, Any]:
    """Solve it so many times; arguments as of `turning`."""
    solver, given, about = turning(steps, settings=settings, **chosen)
    found = solver(**given)
    times = []
    for _ in range(repeats):
        start_time = time.perf_counter()
        found = solver(**given)
        times.append(time.perf_counter() - start_time)
    stats = solver.stats()
    return {
        "cost": float(found["f"]),
        "iterations": int(stats["iter_count"]),
        "outcome": stats["return_status"],
        "violation": float(ca.norm_inf(found["g"])),
        "solve_s": statistics.median(times),
        "solve_s_range": [min(times), max(times)],
        "repeats": repeats,
        "settings": {"model": "minimal", "transcription": "map", "jit": False, "scaled": True}
        | chosen
        | (settings or {}),
    } | about


def cart_pole(
    steps: int,
    method: str = "trapezoidal",
    turn: float = math.pi,
    t_end: float = 2.0,
    released: bool = False,
) -> dict[str, Any]:
    """The swing-up of Kelly's tutorial from a straight line, by trapezoidal collocation or Hermite-Simpson.

    Args:
        steps: number of segments.
        method: "trapezoidal" or "hermite_simpson".
        turn: angle at the end [rad].
        t_end: [s].
        released: whether the force has to vanish at the end, as in the example of Dymos.
    """
    m1, m2, length, gravity = 1.0, 0.3, 0.5, 9.81
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u")
    sine, cosine = ca.sin(x[1]), ca.cos(x[1])
    below = m1 + m2 * sine**2
    first = (length * m2 * sine * x[3] ** 2 + u + m2 * gravity * cosine * sine) / below
    second = (length * m2 * cosine * sine * x[3] ** 2 + u * cosine + (m1 + m2) * gravity * sine) / -(
        length * below
    )
    f = ca.Function("f", [x, u], [ca.vertcat(x[2:], first, second)])
    h, fine = t_end / steps, 2 * steps if method == "hermite_simpson" else steps
    X, U = ca.SX.sym("X", 4, fine + 1), ca.SX.sym("U", 1, fine + 1)
    rates = [f(X[:, k], U[k]) for k in range(fine + 1)]
    g, cost = [], 0
    for k in range(steps):
        if method == "trapezoidal":
            g.append(X[:, k + 1] - X[:, k] - h / 2 * (rates[k] + rates[k + 1]))
            cost += h / 2 * (U[k] ** 2 + U[k + 1] ** 2)
        else:
            a, b, c = 2 * k, 2 * k + 1, 2 * k + 2
            g.append(X[:, c] - X[:, a] - h / 6 * (rates[a] + 4 * rates[b] + rates[c]))
            g.append(X[:, b] - (X[:, a] + X[:, c]) / 2 - h / 8 * (rates[a] - rates[c]))
            cost += h / 6 * (U[a] ** 2 + 4 * U[b] ** 2 + U[c] ** 2)
    end = np.array([1.0, turn, 0.0, 0.0])
    high = np.full((4, fine + 1), np.inf)
    high[0] = 2.0
    low = -high
    low[:, 0] = high[:, 0] = 0.0
    low[:, -1] = high[:, -1] = end
    line = end[:, None] * np.linspace(0, 1, fine + 1)
    limit = np.full(fine + 1, 20.0)
    limit[-1] = 0.0 if released else 20.0
    nlp = {"x": ca.vertcat(ca.vec(X), ca.vec(U)), "f": cost, "g": ca.vertcat(*g)}
    solver = ca.nlpsol("solver", "ipopt", nlp, _options(False))
    found = solver(
        x0=np.concatenate([line.ravel("F"), np.zeros(fine + 1)]),
        lbx=np.concatenate([low.ravel("F"), -limit]),
        ubx=np.concatenate([high.ravel("F"), limit]),
        lbg=0,
        ubg=0,
    )
    stats = solver.stats()
    settings = {"method": method, "turn": turn, "released": released}
    return {
        "cost": float(found["f"]),
        "iterations": int(stats["iter_count"]),
        "outcome": stats["return_status"],
        "settings": settings,
    }


def wait(steps: int, **chosen: Any) -> None:
    """Solve the spacecraft's turn whenever a line is read."""
    solver, given, about = turning(steps, **chosen)

    def solve() -> dict[str, Any]:
        found, stats = solver(**given), solver.stats()
        return {
            "cost": float(found["f"]),
            "iterations": int(stats["iter_count"]),
            "outcome": stats["return_status"],
            "violation": float(ca.norm_inf(found["g"])),
        }

    serve(solve, {"peer": "CasADi", "version": ca.__version__} | about)


def main() -> None:
    """Print one JSON line, or one for each that is read."""
    problem, steps, *words = sys.argv[1:]
    settings = {}
    for word in words:
        key, _, value = word.partition("=")
        try:
            settings[key] = json.loads(value)
        except json.JSONDecodeError:
            settings[key] = value
    if problem == "waiting":
        wait(int(steps), **settings)
        return
    run = {"reorientation": reorientation, "cart_pole": cart_pole}[problem]
    found = {"peer": "casadi", "version": ca.__version__, "problem": problem, "steps": int(steps)}
    print(json.dumps(found | run(int(steps), **settings)))


if __name__ == "__main__":
    main()
