"""IPOPT, by CasADi, on the discrete problem that `nc.to_nlp` hands out: an oracle for `nc.optimise`.

Only what the solver does is the peer's: equations, bounds and exact derivatives are those of natcoord_jax.
"""

import time
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

import natcoord_jax as nc


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
    """

    ok: bool
    status: str
    x: np.ndarray
    cost: float
    multipliers: np.ndarray
    iterations: int
    seconds: float


class _Function(ca.Callback):
    """A function of columns, computed by NumPy; inputs by name and size, outputs by name and pattern."""

    def __init__(
        self, name: str, function: Any, inputs: dict[str, int], outputs: dict[str, ca.Sparsity]
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

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(list(self.inputs.values())[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return list(self.outputs.values())[i]

    def eval(self, arg: list[Any]) -> list[ca.DM]:
        found = self.function(*(np.asarray(x).reshape(-1) for x in arg))
        return [ca.project(ca.DM(np.asarray(x)), pattern) for x, pattern in zip(found, self.outputs.values())]


def solved(program: nc.NonlinearProgram, max_iter: int = 500, **options: Any) -> Answer:
    """Solve a nonlinear program.

    Args:
        program: what `nc.to_nlp` returned.
        max_iter: limit of iterations.
        options: of IPOPT.
    """
    n, c = program.start.size, program.lower.size
    # Warm: compilation is not what is compared.
    program.jacobian(program.start), program.hessian(program.start, 1.0, np.zeros(c))
    column, whole = ca.Sparsity.dense(c, 1), ca.Sparsity.dense(c, n)
    triangle = ca.Sparsity.upper(n)

    def values(x: np.ndarray, _: np.ndarray) -> tuple:
        return program.cost(x), program.constraints(x)

    def gradient(x: np.ndarray, _: np.ndarray) -> tuple:
        return program.cost(x), program.gradient(x)

    def jacobian(x: np.ndarray, _: np.ndarray) -> tuple:
        return program.constraints(x), program.jacobian(x)

    def hessian(x: np.ndarray, _: np.ndarray, weight: np.ndarray, multipliers: np.ndarray) -> tuple:
        return (program.hessian(x, weight[0], multipliers),)

    at, scalar = {"x": n, "p": 0}, ca.Sparsity.dense(1, 1)
    nlp = _Function("nlp", values, at, {"f": scalar, "g": column})
    row = ca.Sparsity.dense(n, 1)
    functions = {
        "grad_f": _Function("grad_f", gradient, at, {"f": scalar, "grad_f_x": row}),
        "jac_g": _Function("jac_g", jacobian, at, {"g": column, "jac_g_x": whole}),
        "hess_lag": _Function(
            "hess_lag", hessian, {**at, "lam_f": 1, "lam_g": c}, {"triu_hess_gamma_x_x": triangle}
        ),
    }
    ipopt = {"print_level": 0, "sb": "yes", "max_iter": max_iter, "tol": 1e-8, **options}
    settings = {**functions, "ipopt": ipopt, "print_time": False, "no_nlp_grad": True}
    solver = ca.nlpsol("solver", "ipopt", nlp, settings)
    start = time.perf_counter()
    found = solver(x0=program.start, lbg=program.lower, ubg=program.upper)
    seconds = time.perf_counter() - start
    stats = solver.stats()
    return Answer(
        bool(stats["success"]),
        str(stats["return_status"]),
        np.asarray(found["x"]).reshape(-1),
        float(found["f"]),
        np.asarray(found["lam_g"]).reshape(-1),
        int(stats["iter_count"]),
        seconds,
    )
