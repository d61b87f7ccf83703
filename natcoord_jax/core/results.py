"""Result codes that travel through compiled programs, and the error raised from them, outermost."""

from enum import IntEnum

from natcoord_jax.xla.reported import DerivativeError as DerivativeError


class Result(IntEnum):
    """How a step or a rollout ended."""

    SUCCESSFUL = 0
    EVENT = 1
    MAX_ITERATIONS = 2
    DIVERGED = 3
    NONFINITE = 4
    SINGULAR = 5
    MAX_SUBSTEPS = 6
    BAD_STEP = 7
    TOLERANCE_NOT_MET = 8
    INTERRUPTED = 9
    INVERTED = 10
    MISSED = 11
    OVERFLOW = 12
    BAD_START = 13
    JUMPED = 14
    UNSTEADY = 15

    @property
    def ok(self) -> bool:
        """Whether the trajectory is valid to its end."""
        return self in (Result.SUCCESSFUL, Result.EVENT, Result.INTERRUPTED)


REASONS = {
    Result.SUCCESSFUL: "successful",
    Result.EVENT: "a terminal event ended the run",
    Result.MAX_ITERATIONS: "Newton's iteration did not converge within its maximum of iterations",
    Result.DIVERGED: "Newton's iteration diverged",
    Result.NONFINITE: "a number became infinite or not a number",
    Result.SINGULAR: "the equations of motion are singular",
    Result.MAX_SUBSTEPS: "more substeps were needed than `extra_substeps` allows",
    Result.BAD_STEP: "the step dt is not a positive finite number [s]",
    Result.TOLERANCE_NOT_MET: "no substep is short enough for the error that `rtol` and `atol` tolerate",
    Result.INTERRUPTED: "the run was interrupted before its end, or is still being made",
    Result.INVERTED: "an element was turned inside out",
    Result.MISSED: "bodies have moved in a step beyond where contacts were looked for",
    Result.OVERFLOW: "a body has more neighbours than its contact has room for",
    Result.BAD_START: "the positions at the start violate the constraints",
    Result.JUMPED: "a drive jumps, or swings to and fro within the shortest step",
    Result.UNSTEADY: "the rotation is not steady",
}

REMEDIES = {
    Result.MAX_ITERATIONS: "use a smaller dt or allow more `extra_substeps`",
    Result.DIVERGED: "use a smaller dt or allow more `extra_substeps`",
    Result.NONFINITE: "check inputs, parameters and user-defined effects for undefined operations",
    Result.SINGULAR: "check for bodies without inertia along a free motion, and for conflicting drives",
    Result.MAX_SUBSTEPS: "use a smaller dt or allow more `extra_substeps`",
    Result.BAD_STEP: "pass dt > 0",
    Result.TOLERANCE_NOT_MET: "use a larger `rtol` or `atol`; 1e-13 of the motion is round-off",
    Result.INTERRUPTED: "what was stored by `store` goes on with `resume=True`",
    Result.INVERTED: "use a smaller dt, a finer mesh, or a material that resists, as nc.NeoHooke",
    Result.MISSED: "use a smaller dt, or a larger `skin` of the nc.Contact",
    Result.BAD_START: "pass nc.assemble(system, state)",
    Result.JUMPED: "give it a function without jumps, as a ramp of some steps, or use a smaller dt",
    Result.OVERFLOW: "pass a larger `capacity` to the nc.Contact, or a smaller dt or `skin`",
    Result.UNSTEADY: "let all that acts turn along, and a drive or a motor balance the torque about the axis",
}


class SimulationError(RuntimeError):
    """A simulation that failed, raised once, outermost.

    Attributes:
        result: the result code.
        trajectory: what was computed; the states after the failure repeat the last valid one.
    """

    def __init__(self, message: str, result: Result, trajectory):
        super().__init__(message)
        self.result = result
        self.trajectory = trajectory
