"""The entrances: an optimisation with progress and a way out, and one that compiles into other programs."""

import dataclasses
import math
from typing import Annotated, Any

import numpy as np

from natcoord_jax.control import sequential
from natcoord_jax.control.attempts import ENDED, NAMES, Search, after_restoration, best_of, over
from natcoord_jax.control.guess import GUESS, Guess, unknowns_of
from natcoord_jax.control.ipopt import MOST, installed
from natcoord_jax.control.iterate import Iterate, Options
from natcoord_jax.control.problem import PROBLEM, OptimalControl, numeric
from natcoord_jax.control.reasons import outside_at_start, waiting
from natcoord_jax.control.results import Outcome
from natcoord_jax.control.simultaneous import sizes_of
from natcoord_jax.control.solution import Solution
from natcoord_jax.control.transcription import Unknowns, held_inputs
from natcoord_jax.control.turns import lost as lost_turns
from natcoord_jax.control.turns import turned_along, turned_by, uncounted
from natcoord_jax.control.undefined import idle_inputs, refuse_undefined
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.kinds import FLAG, Choice, Concrete, of
from natcoord_jax.core.numeric import Number, Whole

FORMS = ("auto", "shooting", "lifted")
METHODS = (*FORMS, "ipopt")
DEFAULT = Options()
UNKNOWNS = of("unknowns, as the `unknowns` of an iterate", Unknowns)
OPTIONS = of("natcoord_jax.control.iterate.Options(...)", Options)


def chosen(problem: OptimalControl, method: str, guess: Any = None) -> bool:
    """Whether to lift: where time or parameters are free or the path is bounded, simulations lead astray."""
    if method != "auto":
        return method == "lifted"
    if problem.free_time:
        return True
    if isinstance(guess, Solution) and guess.iterate is not None:
        # What it was found by has been compiled, and led to it.
        return guess.method.startswith(NAMES[True])
    inputs = all(label.startswith("input ") for label in problem.path_labels)
    return bool(problem.free) or not inputs


@checked()
def optimise(
    problem: Annotated[OptimalControl, Concrete(PROBLEM)],
    guess: Annotated[Any, GUESS | of("an earlier solution", Solution)] = None,
    *,
    method: Annotated[str, Choice(METHODS)] = "auto",
    progress: Annotated[bool, FLAG] = True,
    max_iterations: Annotated[int, Whole(0)] = 500,
    tol: Annotated[float, Concrete(Number("positive"))] = 1e-8,
    goal_tol: Annotated[float, Concrete(Number("positive"))] = 1e-10,
    time_limit: Annotated[float, Concrete(Number("not negative", infinite=True))] = 600.0,
) -> Solution:
    """Solve an optimal control problem by the second-order method.

    Sequential quadratic programming on the discrete motion with exact gradients, an interior point for the
    bounds and linear algebra that is linear in the number of steps. "shooting" simulates every iterate;
    "lifted" takes the equations of all steps as constraints (as in discrete mechanics and optimal control),
    for swing-ups, minimum time and bounded paths. For any smooth loss without these, see `nc.descend`.

    Args:
        problem: the problem.
        guess: inputs (steps, inputs), a `Guess`, an earlier `Solution`, or None.
        method: "shooting", "lifted" or "auto": that of an earlier solution as guess, else lifted if
            parameters are free or more than inputs is bounded; with free time always lifted. Where "shooting"
            gets lost, "auto" goes on lifted; where that does, it asks IPOPT if it is installed
            (`pip install 'natcoord-jax[ipopt]'`); then "auto" and "lifted" look for a motion that comes near
            to the goal, by simulations that may miss it at a cost (feasibility restoration), and go on from
            there; then from random inputs. "ipopt": by IPOPT alone, on `nc.to_nlp` with states. What is
            returned is the best of all attempts, and what they saw is in `explain()`. That a goal is out of
            reach is said only where two methods agree, or four starts, and to first order no inputs within
            their limits lead there.
        progress: print a line for each iteration to stderr.
        max_iterations: limit of iterations, of all attempts together.
        tol: largest gradient of the Lagrangian and complementarity, relative.
        goal_tol: largest violation of goal, bounds and equations.
        time_limit: limit of time [s], of all attempts together; checked between iterations. Compiling does
            not count.

    Returns:
        The solution; `outcome` and `explain()` say how it ended. An interruption by the keyboard returns
        what was reached.

    Raises:
        ValueError: for a guess of the wrong shape or an unknown method; for a running cost or a bound without
            a value or slope at the start; where no input acts on anything.
        ModuleNotFoundError: for method "ipopt" where it is not installed.
    """
    problem = numeric(problem)
    lifted, given = chosen(problem, method, guess), guess
    if isinstance(guess, Solution):
        guess = guess.guess_for(problem)
    guess = guess if isinstance(guess, Guess) else Guess(inputs=guess)
    outside = outside_at_start(problem)
    if outside:
        # (Nothing is made of the guess then that would have to be compiled.)
        start = unknowns_of(problem, Guess(inputs=guess.inputs, free=guess.free), False)
        names, values = problem.free, np.asarray(problem.values(start.free)).tolist()
        inputs, dt = held_inputs(problem, start.coefficients), float(problem.applied(start.free)[1])
        code = int(Outcome.INFEASIBLE_START)
        reason = ", ".join(f"{name}, missed by {x:.2g} of half the range" for name, x in outside.items())
        free = dict(zip(names, values))
        return Solution(problem, inputs, free, dt, math.nan, code, NAMES[lifted], reason=reason)
    if not isinstance(given, Solution):
        _refuse(problem, guess)
    start = unknowns_of(problem, guess, lifted)
    search = Search(problem, Options(lifted, max_iterations, tol, goal_tol), progress, time_limit)
    found = _attempted(search, method, start, guess)
    notes = _lost_turns(given, start, found), waiting(problem, found.free)
    return dataclasses.replace(found, note="; ".join(note for note in notes if note))


def _refuse(problem: OptimalControl, guess: Guess) -> None:
    """Refuse what can be seen to lead nowhere before anything is compiled."""
    if not problem.free_numbers:
        refuse_undefined(problem, None if guess.inputs is None else np.asarray(guess.inputs)[0])
    channels, idle = problem.system.structure.inputs, idle_inputs(problem)
    if channels and len(idle) == len(channels) and not problem.free_numbers:
        raise ValueError(
            f"the inputs {list(idle)} act on no free motion of the system: their gear is zero, or they push "
            "along or about what the joint holds, as nc.JointTorque does on a slide; give them a gear, or "
            "use nc.JointForce on slides"
        )


def _attempted(search: Search, method: str, start: Unknowns, guess: Guess) -> Solution:
    """The best of all attempts that the method allows."""
    problem, lifted = search.problem, search.options.lifted
    if method == "ipopt":
        return search.by_ipopt(unknowns_of(problem, guess, True))
    # Restored motions are gone on from in the lifted form.
    found = search.run(lifted, start, last=method == "shooting")
    if method == "auto" and not lifted and _lost(found) and search.left > 0:
        other = search.run(True, unknowns_of(problem, guess, True))
        found = other if over(other) else best_of(problem, [found, other], other.outcome)
    asked = installed() and sizes_of(problem).seen <= MOST
    if method == "auto" and _lost(found) and search.left > 0 and asked:
        other = search.by_ipopt(unknowns_of(problem, guess, True))
        if other.ok:
            return other
        if other.outcome in ENDED:
            return best_of(problem, [found, other], other.outcome)
    # Restorations change inputs alone.
    restorable = method != "shooting" and len(problem.system.structure.inputs) > 0
    if restorable and not over(found) and search.left > 0:
        found = after_restoration(search, found, guess)
    return found


def _lost_turns(given: Any, start: Unknowns, found: Solution) -> str:
    """Whole turns of a guess that the solution has not, in words."""
    problem, iterate = found.problem, found.iterate
    names = uncounted(problem)
    if given is None or iterate is None or not names:
        return ""
    if isinstance(given, Solution) and given.iterate is not None:
        turned = turned_along(given.problem, given.iterate.path.nodes.x, names)
    else:
        by_inputs = not isinstance(given, Guess) or given.rates is None
        if by_inputs and isinstance(given, Guess) and given.inputs is None:
            return ""
        turned = turned_by(problem, start, names, by_inputs)
    return "; ".join(lost_turns(turned, turned_along(problem, iterate.path.nodes.x, names)))


def _lost(found: Solution) -> bool:
    return not over(found) and found.outcome is not Outcome.UNREACHABLE


@checked(problem=PROBLEM, unknowns=UNKNOWNS, options=OPTIONS)
@compiled
def optimise_jit(problem: OptimalControl, unknowns: Unknowns, options: Options = DEFAULT) -> Iterate:
    """The method as one program, for `jax.vmap`, receding horizons and other programs around it.

    Args:
        problem: the problem; every number of it may be traced.
        unknowns: where to start; see `unknowns_of`.
        options: settings.

    Returns:
        The last iterate; its `code` says how it ended.
    """
    return sequential.solved(problem, options, unknowns)
