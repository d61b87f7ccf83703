"""Where the second-order method stands: plain data."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.control.costates import Charts, Costates, Jacobians, Multipliers
from natcoord_jax.control.transcription import Path, Unknowns


class Options(eqx.Module):
    """Settings of the second-order method.

    Attributes:
        lifted: whether residuals of the steps vanish at the end only.
        max_iterations: of the method.
        tol: largest gradient of the Lagrangian and complementarity, relative.
        goal_tol: largest residual of the goal, in its units, of the bounds, in theirs, and of the steps.
        barrier: barrier parameter at the start, of every bound, relative to the cost; a small one lets the
            first steps, which know no multipliers yet, run into bounds.
    """

    lifted: bool = eqx.field(default=False, static=True)
    max_iterations: int = eqx.field(default=100, static=True)
    tol: float = eqx.field(default=1e-8, static=True)
    goal_tol: float = eqx.field(default=1e-10, static=True)
    barrier: float = eqx.field(default=0.01, static=True)


class Slacks(eqx.Module):
    """Room left to the bounds at every step and to those of what is free; positive."""

    path: Float[Array, "*batch steps h"]
    end: Float[Array, "*batch e"]


class Errors(eqx.Module):
    """What is missing to the conditions of optimality.

    Attributes:
        stationarity: gradient of the Lagrangian, relative to the gradient of the cost or of the bounds.
        motion: residual of the steps, as relative change of their unknowns.
        goal: largest residual of the goal.
        bounds: largest violation of a bound.
        complementarity: multiplier times room, relative to the cost.
    """

    stationarity: Float[Array, "*batch"]
    motion: Float[Array, "*batch"]
    goal: Float[Array, "*batch"]
    bounds: Float[Array, "*batch"]
    complementarity: Float[Array, "*batch"]


class Derivatives(eqx.Module):
    """First derivatives at a motion.

    Attributes:
        jacobians: of the equations of the steps.
        maps: small numbers of the nodes.
        worth: costates.
        bending: those that the curvature is taken with.
        by_w: gradient of the Lagrangian in the entering coefficients.
        by_first: gradient in what is free and the leading coefficients.
        errors: what is missing.
    """

    jacobians: Jacobians
    maps: Charts
    worth: Costates
    bending: Costates
    by_w: Float[Array, "*batch steps m"]
    by_first: Float[Array, "*batch f"]
    errors: Errors


class Model(eqx.Module):
    """Linear dynamics and quadratic costs in small numbers z (see `tangent`), w and what is free.

    z holds changes of the state, of what is free and of the register; w those of entering coefficients. The
    unknowns y of a step follow from both by its linearised equations: dy = y [z, w] + dy0, and dy0 removes
    what is left of them.

    Attributes:
        forward: z_k+1 = forward [z_k, w_k] + forward_y dy0, (steps, z, z + m).
        hessian: of the Lagrangian in [z, w] (steps, z + m, z + m).
        excess: derivative of the excesses (steps, h, z + m).
        y: of the unknowns (steps, n, z + m).
        forward_y: of z_k+1 in y (steps, z, n).
        excess_y: of the excesses in y (steps, h, n).
        slope_y: of the Lagrangian's slope in y per [z, w] (steps, n, z + m).
        bent_y: of that slope in y (steps, n, n).
        last_hessian: of the terminal Lagrangian (z, z).
        goal: derivative of the goal (c, z).
        last_excess: derivative of the terminal excesses (e, z).
        first: z_0 per what is free and leading coefficients (z, f).
        first_hessian: (f, f).
    """

    forward: Float[Array, "*batch steps z zm"]
    hessian: Float[Array, "*batch steps zm zm"]
    excess: Float[Array, "*batch steps h zm"]
    y: Float[Array, "*batch steps n zm"]
    forward_y: Float[Array, "*batch steps z n"]
    excess_y: Float[Array, "*batch steps h n"]
    slope_y: Float[Array, "*batch steps n zm"]
    bent_y: Float[Array, "*batch steps n n"]
    last_hessian: Float[Array, "*batch z z"]
    goal: Float[Array, "*batch c z"]
    last_excess: Float[Array, "*batch e z"]
    first: Float[Array, "*batch z f"]
    first_hessian: Float[Array, "*batch f f"]


class Filter(eqx.Module):
    """What the search for a step remembers, see `line_search`.

    Attributes:
        violations: that no iterate may exceed together with the cost beside it; infinite where none is.
        costs: barrier costs, in units of the cost.
        count: how many have been written.
        units: of the residuals of a step: what they change of positions, roughly, over the whole motion.
        least: violation below which a step is for the cost.
        largest: violation that is never exceeded.
    """

    violations: Float[Array, "*batch k"]
    costs: Float[Array, "*batch k"]
    count: Int[Array, "*batch"]
    units: Float[Array, "*batch n"]
    least: Float[Array, "*batch"]
    largest: Float[Array, "*batch"]


class Iterate(eqx.Module):
    """Where the method stands.

    Attributes:
        unknowns: what is solved for.
        multipliers: of goal and bounds.
        slacks: room left.
        path: the motion.
        derivatives: first derivatives there.
        barrier: barrier parameter.
        unit: of the cost.
        shift: last increase of the curvature.
        sway: part of it that the unknowns of the steps get [curvature in them per curvature in coefficients].
        penalty: weight of the goal's square in the model.
        softness: of the goal: missing it by x costs x^2 / (2 softness); zero where it is to be reached.
        filter: what the search for a step remembers.
        step: length of the last step.
        moved: size of the last step, relative.
        unreachable: part of the goal that nothing could change.
        saddle: whether the curvature is negative along some direction, as the last step found.
        iteration: number of steps made.
        newton: Newton iterations of all simulations.
        failures: steps given up in a row.
        code: see `Outcome`.
    """

    unknowns: Unknowns
    multipliers: Multipliers
    slacks: Slacks
    path: Path
    derivatives: Derivatives
    barrier: Float[Array, "*batch"]
    unit: Float[Array, "*batch"]
    shift: Float[Array, "*batch"]
    sway: Float[Array, "*batch"]
    penalty: Float[Array, "*batch c"]
    softness: Float[Array, "*batch c"]
    filter: Filter
    step: Float[Array, "*batch"]
    moved: Float[Array, "*batch"]
    unreachable: Float[Array, "*batch c"]
    saddle: Bool[Array, "*batch"]
    iteration: Int[Array, "*batch"]
    newton: Int[Array, "*batch"]
    failures: Int[Array, "*batch"]
    code: Int[Array, "*batch"]

    @property
    def errors(self) -> Errors:
        """What is missing to the conditions of optimality."""
        return self.derivatives.errors

    @property
    def running(self) -> Bool[Array, "*batch"]:
        """Whether the method goes on."""
        return self.code == 1


def largest(*arrays: Array) -> Array:
    """Largest magnitude of all entries; zero if there are none."""
    return jnp.max(jnp.concatenate([jnp.zeros(1), *(jnp.abs(x).reshape(-1) for x in arrays)]))
