"""How an optimisation ended."""

from enum import IntEnum


class Outcome(IntEnum):
    """How an optimisation ended."""

    OPTIMAL = 0
    RUNNING = 1
    MAX_ITERATIONS = 2
    UNREACHABLE = 3
    STALLED = 4
    SIMULATION_FAILED = 5
    NONFINITE = 6
    STOPPED = 7
    TIME_LIMIT = 8
    SINGULAR = 9
    INFEASIBLE_START = 10
    DIVERGED = 11
    UNDETERMINED = 12

    @property
    def ok(self) -> bool:
        """Whether the solution fulfils the conditions of optimality."""
        return self is Outcome.OPTIMAL


OUTCOMES = {
    Outcome.OPTIMAL: "optimal",
    Outcome.RUNNING: "still running",
    Outcome.MAX_ITERATIONS: "the maximum of iterations was reached",
    Outcome.UNREACHABLE: "no motion was found that reaches the goal",
    Outcome.STALLED: "no step along the search direction made progress",
    Outcome.SIMULATION_FAILED: "the motion of the guess could not be simulated",
    Outcome.NONFINITE: "a number became infinite or not a number",
    Outcome.STOPPED: "stopped by the user",
    Outcome.TIME_LIMIT: "the time limit was reached",
    Outcome.SINGULAR: "a step has no derivative: its linearised equations have no solution",
    Outcome.INFEASIBLE_START: "the start is outside of bounds that no input can change there",
    Outcome.DIVERGED: "the multipliers grew without end",
    Outcome.UNDETERMINED: "the data do not determine all unknowns",
}

ADVICE = {
    Outcome.MAX_ITERATIONS: "allow more iterations, widen limits that hold it, or start from a better guess",
    Outcome.UNREACHABLE: "check for conditions that contradict each other or the conservation laws, for "
    "inputs that cannot move what the goal asks for, and for too little time or too narrow limits; start "
    "from another guess",
    Outcome.STALLED: "start from another guess, widen limits that hold it, or look for cost, goal or bounds "
    "that are not smooth",
    Outcome.SIMULATION_FAILED: "start from a milder guess or with a smaller dt, or use method='lifted'",
    Outcome.SINGULAR: "start from a guess that keeps away from positions where constraints depend on "
    "each other",
    Outcome.INFEASIBLE_START: "start inside of them, or widen them (the zero of a joint coordinate is "
    "the pose in which the scene was compiled)",
    Outcome.DIVERGED: "look for conditions of the goal that depend on each other, or a time that is too "
    "short; start from another guess",
    Outcome.NONFINITE: "check cost, goal and bounds for undefined operations",
}
