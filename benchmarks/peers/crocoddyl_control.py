"""Cart-pole, an arm with seven axes and a spacecraft by Crocoddyl: dynamic programming within limits.

As a command, `python -m benchmarks.peers.crocoddyl_control panda 40` waits for lines, see `asked`. It needs
`crocoddyl` and `pin`, in an environment of their own.

Its solvers with limits of the inputs (`SolverBoxFDDP`) know no conditions at the end: the goal is a penalty,
a square with a large weight, so that it is missed by a little, which is said. Steps are its own, symplectic
Euler with inputs held. The start is its usual one: at rest where the motion begins, with torques that hold
it.
"""

import math
import sys
import time
from typing import Any

import crocoddyl
import numpy as np
import pinocchio

from benchmarks.peers import panda, spacecraft
from benchmarks.peers.asked import serve

WEIGHT = 1e6
"""Of the goal."""


def _about_x(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])


def arm() -> pinocchio.Model:
    """The arm."""
    model, joint = pinocchio.Model(), 0
    for k, ((mass, com, inertia), (length, offset, twist)) in enumerate(zip(panda.LINKS, panda.FRAMES)):
        place = np.array([length, -math.sin(twist) * offset, math.cos(twist) * offset])
        frame = pinocchio.SE3(_about_x(twist), place)
        joint = model.addJoint(joint, pinocchio.JointModelRZ(), frame, f"joint {k + 1}")
        body = pinocchio.Inertia(mass, np.array(com), np.diag(inertia))
        model.appendBodyToJoint(joint, body, pinocchio.SE3.Identity())
    model.gravity.linear = np.array([0.0, 0.0, -panda.GRAVITY])
    return model


def cart_pole() -> pinocchio.Model:
    """The cart along x, the pole turning about -y, hanging at zero."""
    model, still = pinocchio.Model(), pinocchio.SE3.Identity()
    cart = model.addJoint(0, pinocchio.JointModelPX(), still, "rail")
    model.appendBodyToJoint(cart, pinocchio.Inertia(1.0, np.zeros(3), np.eye(3)), still)
    axis = pinocchio.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0]))
    pole = model.addJoint(cart, axis, still, "hinge")
    bob = pinocchio.Inertia(0.3, np.array([0.0, 0.0, -0.5]), np.zeros((3, 3)))
    model.appendBodyToJoint(pole, bob, still)
    model.gravity.linear = np.array([0.0, 0.0, -panda.GRAVITY])
    return model


def craft() -> pinocchio.Model:
    """The spacecraft of the paper: a base that floats, and three wheels."""
    model, still = pinocchio.Model(), pinocchio.SE3.Identity()
    base = model.addJoint(0, pinocchio.JointModelFreeFlyer(), still, "root_joint")
    for k, body in enumerate(spacecraft.BODIES):
        joint, own = base, pinocchio.Inertia(body["mass"], np.zeros(3), np.diag(body["inertia"]))
        if k:
            axis = pinocchio.JointModelRevoluteUnaligned(np.array(body["axes"][0]))
            place = pinocchio.SE3(np.eye(3), np.array(body["point"]))
            joint = model.addJoint(base, axis, place, body["name"])
        model.appendBodyToJoint(joint, own, still)
    model.gravity.linear = np.zeros(3)
    return model


def _craft_problem() -> "Problem":
    half = math.pi / 4
    turned = [*(math.sin(half) * np.array([1.0, 2.0, -1.0]) / math.sqrt(6)), math.cos(half)]
    still, start = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
    # Neither the place of the base nor the angles of the wheels are asked for.
    asked = np.r_[0, 0, 0, 1, 1, 1, 0, 0, 0, np.ones(9)]
    limits = [200.0] * 3
    return Problem(craft(), still + start + still, still + turned + still, limits, 60.0, asked=asked)


class Problem:
    """A motion from rest to rest by least effort.

    Attributes:
        model: of Pinocchio.
        start: posture.
        end: posture.
        limits: of the inputs, which may be fewer than the coordinates.
        t_end: [s].
        rates: weight of their squares.
        asked: what of the state is asked for at the end, 1 or 0.
    """

    def __init__(
        self,
        model: Any,
        start: Any,
        end: Any,
        limits: Any,
        t_end: float,
        rates: float = 0.0,
        asked: Any = None,
    ) -> None:
        self.model, self.t_end, self.rates = model, t_end, rates
        self.asked = np.ones(2 * model.nv) if asked is None else asked
        self.start, self.end, self.limits = (np.array(x, float) for x in (start, end, limits))


PROBLEMS = {
    "cart_pole": lambda: Problem(cart_pole(), (0, 0), (1, math.pi), (20,), 2.0),
    "panda": lambda: Problem(arm(), panda.START, panda.END, panda.LIMITS, panda.T_END, panda.RATES),
    "reorientation": _craft_problem,
}


class FirstOnly(crocoddyl.ActuationModelAbstract):
    """Inputs of the first coordinates only."""

    def __init__(self, state: Any, count: int) -> None:
        super().__init__(state, count)

    def calc(self, data: Any, x: Any, u: Any) -> None:
        """Forces."""
        data.tau = np.concatenate([u, np.zeros(self.state.nv - self.nu)])

    def calcDiff(self, data: Any, x: Any, u: Any) -> None:  # noqa: N802
        """They are the inputs."""
        data.dtau_du = np.eye(self.state.nv, self.nu)


def solver_of(problem: Problem, steps: int) -> tuple[Any, list[np.ndarray], list[np.ndarray]]:
    """The solver, and the states and inputs that it starts from."""
    state, n, count = crocoddyl.StateMultibody(problem.model), problem.model.nv, len(problem.limits)
    if problem.model.nq > n:
        actuation = crocoddyl.ActuationModelFloatingBase(state)
    else:
        actuation = crocoddyl.ActuationModelFull(state) if count == n else FirstOnly(state, count)
    effort = crocoddyl.CostModelResidual(state, crocoddyl.ResidualModelControl(state, count))
    h, start = problem.t_end / steps, np.concatenate([problem.start, np.zeros(n)])
    target = np.concatenate([problem.end, np.zeros(n)])
    asked = crocoddyl.ActivationModelWeightedQuad(problem.asked)
    reach = crocoddyl.CostModelResidual(state, asked, crocoddyl.ResidualModelState(state, target, count))

    slow = crocoddyl.CostModelResidual(
        state,
        crocoddyl.ActivationModelWeightedQuad(np.r_[np.zeros(n), np.ones(n)]),
        crocoddyl.ResidualModelState(state, start, count),
    )

    running_costs = [("effort", effort, 2.0), ("rates", slow, 2.0 * problem.rates)]

    def action(dt: float, *, last: bool) -> Any:
        costs = crocoddyl.CostModelSum(state, count)
        # (Its costs are half of squares.)
        for name, cost, weight in [("goal", reach, WEIGHT)] if last else running_costs:
            costs.addCost(name, cost, weight)
        free = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)
        # With Pinocchio 4.1, derivatives of Crocoddyl 3.2.1 lack gravity without armature, which may be zero.
        free.armature = np.zeros(n)
        found = crocoddyl.IntegratedActionModelEuler(free, dt)
        found.u_lb, found.u_ub = -problem.limits, problem.limits
        return found

    running, last = action(h, last=False), action(0.0, last=True)
    shooting = crocoddyl.ShootingProblem(start, [running] * steps, last)
    rest = np.zeros(n)
    hold = pinocchio.rnea(problem.model, problem.model.createData(), problem.start, rest, rest)
    hold = np.zeros(count) if problem.model.nq > n else hold[:count]
    states, inputs = [start] * (steps + 1), [hold] * steps
    return crocoddyl.SolverBoxFDDP(shooting), states, inputs


def main() -> None:
    """Wait for lines."""
    name, steps = sys.argv[1], int(sys.argv[2])
    begun = time.perf_counter()
    problem = PROBLEMS[name]()
    solver, states, inputs = solver_of(problem, steps)
    solver.th_stop = 1e-9
    h = problem.t_end / steps

    def solve() -> dict[str, Any]:
        ok = solver.solve(states, inputs, 2000, False)
        target = np.concatenate([problem.end, np.zeros(problem.model.nv)])
        missed = problem.asked * solver.problem.terminalModel.state.diff(target, solver.xs[-1])
        rates = np.array(list(solver.xs))[:, problem.model.nq :]
        return {
            "cost": h * (sum(float(u @ u) for u in solver.us) + problem.rates * float(np.sum(rates**2))),
            "iterations": int(solver.iter),
            "outcome": "converged" if ok else "not converged",
            "violation": float(np.max(np.abs(missed))),
        }

    about = {"peer": "Crocoddyl", "version": crocoddyl.__version__}
    serve(solve, about | {"setup_s": time.perf_counter() - begun})


if __name__ == "__main__":
    main()
