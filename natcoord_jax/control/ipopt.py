"""IPOPT, by CasADi, on the sparse program of `nc.to_nlp`: a second method, where it is installed.

Equations, bounds and derivatives are those of this package; only what the solver does is the other's. See
A. Waechter, L. T. Biegler, Math. Program. 106 (2006) 25-57, and
J. A. E. Andersson et al., Math. Prog. Comp. 11 (2019) 1-36.
"""

import importlib.util
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from natcoord_jax.control.nlp import NonlinearProgram

EXTRA = "pip install 'natcoord-jax[ipopt]'"
"""What it needs."""
METIS = 5
"""Order of elimination by nested dissection: for seven axes it takes half the time of the default one."""

MOST = 2000
"""Numbers that one step may see where it is asked without being told to: those of a step are eliminated
together, in a time that goes with their cube."""

Structure = tuple[np.ndarray, np.ndarray]
"""Rows and columns."""


class Answer(NamedTuple):
    """What IPOPT returned.

    Attributes:
        ok: whether it is locally optimal.
        status: in its words.
        x: the vector.
        cost: at x.
        multipliers: of the constraints.
        iterations: how many.
        seconds: inside the solver, without compilation.
        table: of every iteration the cost, the slope, the violation and the length of the step.
    """

    ok: bool
    status: str
    x: np.ndarray
    cost: float
    multipliers: np.ndarray
    iterations: int
    seconds: float
    table: list[tuple[float, float, float, float]]


def installed() -> bool:
    """Whether it can be used."""
    return importlib.util.find_spec("casadi") is not None


def _callback(ca: Any) -> Any:
    """Functions of CasADi that NumPy computes: a class, which needs the library."""

    class Function(ca.Callback):
        """A function of columns, computed by NumPy; inputs by name and size, outputs by name and pattern."""

        def __init__(
            self, name: str, function: Callable, inputs: dict[str, int], outputs: dict[str, Any]
        ) -> None:
            ca.Callback.__init__(self)
            self.function, self.inputs, self.outputs = function, inputs, outputs
            self.construct(name, {})

        def get_n_in(self) -> int:
            return len(self.inputs)

        def get_n_out(self) -> int:
            return len(self.outputs)

        def get_name_in(self, i: int) -> str:
            return list(self.inputs)[i]

        def get_name_out(self, i: int) -> str:
            return list(self.outputs)[i]

        def get_sparsity_in(self, i: int) -> Any:
            return ca.Sparsity.dense(list(self.inputs.values())[i], 1)

        def get_sparsity_out(self, i: int) -> Any:
            return list(self.outputs.values())[i]

        def eval(self, arg: list[Any]) -> list[Any]:
            found = self.function(*(np.asarray(x).reshape(-1) for x in arg))
            patterns = self.outputs.values()
            return [ca.DM(pattern, np.asarray(x).ravel()) for x, pattern in zip(found, patterns)]

    return Function


def _placed(ca: Any, shape: tuple[int, int], places: Structure) -> tuple[Any, Any]:
    """A pattern of CasADi, and the order of the entries in it."""
    rows, columns = places
    order = np.lexsort((rows, columns))
    return ca.Sparsity.triplet(*shape, rows[order].tolist(), columns[order].tolist()), order


def structures_of(program: NonlinearProgram) -> tuple[Structure, Structure]:
    """Places of the entries of its Jacobian and of the lower triangle of its Hessian.

    Raises:
        ValueError: where it has no states.
    """
    if program.jacobian_structure is None or program.hessian_structure is None:
        raise ValueError("the program has full matrices; pass nc.to_nlp(problem, states=True)")
    return program.jacobian_structure, program.hessian_structure


def _functions(ca: Any, program: NonlinearProgram) -> dict[str, Any]:
    """The program as functions of CasADi, with their derivatives."""
    Function, n, c = _callback(ca), program.start.size, program.lower.size
    places, (rows, columns) = structures_of(program)
    filled, by_column = _placed(ca, (c, n), places)
    # It wants the upper triangle.
    bent, across = _placed(ca, (n, n), (columns, rows))
    column, row, scalar = ca.Sparsity.dense(c, 1), ca.Sparsity.dense(n, 1), ca.Sparsity.dense(1, 1)
    at = {"x": n, "p": 0}

    def slopes(x: np.ndarray, _: Any) -> tuple:
        return program.constraints(x), np.asarray(program.jacobian(x))[by_column]

    def hessian(x: np.ndarray, _: Any, weight: np.ndarray, multipliers: np.ndarray) -> tuple:
        return (np.asarray(program.hessian(x, weight[0], multipliers))[across],)

    return {
        "nlp": Function(
            "nlp", lambda x, _: (program.cost(x), program.constraints(x)), at, {"f": scalar, "g": column}
        ),
        "grad_f": Function(
            "grad_f",
            lambda x, _: (program.cost(x), program.gradient(x)),
            at,
            {"f": scalar, "grad_f_x": row},
        ),
        "jac_g": Function("jac_g", slopes, at, {"g": column, "jac_g_x": filled}),
        "hess_lag": Function(
            "hess_lag", hessian, {**at, "lam_f": 1, "lam_g": c}, {"triu_hess_gamma_x_x": bent}
        ),
    }


def solved(program: NonlinearProgram, max_iter: int = 500, **options: Any) -> Answer:
    """Solve a nonlinear program.

    Args:
        program: what `nc.to_nlp` returned, with states.
        max_iter: limit of iterations.
        options: of IPOPT, as `max_wall_time` [s].

    Raises:
        ModuleNotFoundError: if CasADi is not installed.
        ValueError: for a program without states.
    """
    if not installed():
        raise ModuleNotFoundError(f"IPOPT needs CasADi, which is not installed: {EXTRA}")
    import casadi as ca

    functions = _functions(ca, program)
    ipopt = {"print_level": 0, "sb": "yes", "max_iter": max_iter, "tol": 1e-8, "mumps_pivot_order": METIS}
    ipopt |= options
    settings = {"ipopt": ipopt, "print_time": False, "no_nlp_grad": True}
    settings |= {name: function for name, function in functions.items() if name != "nlp"}
    solver = ca.nlpsol("solver", "ipopt", functions["nlp"], settings)
    # (The first values compile.)
    for function in (program.constraints, program.jacobian):
        function(program.start)
    program.hessian(program.start, 1.0, np.zeros(program.lower.size))
    start = time.perf_counter()
    found = solver(x0=program.start, lbg=program.lower, ubg=program.upper)
    seconds, stats = time.perf_counter() - start, solver.stats()
    rows = stats.get("iterations", {})
    columns = (rows.get(name, []) for name in ("obj", "inf_du", "inf_pr", "alpha_pr"))
    return Answer(
        bool(stats["success"]),
        str(stats["return_status"]).replace("_", " "),
        np.asarray(found["x"]).reshape(-1),
        float(found["f"]),
        np.asarray(found["lam_g"]).reshape(-1),
        int(stats["iter_count"]),
        seconds,
        [tuple(map(float, row)) for row in zip(*columns)],  # type: ignore[misc]
    )
