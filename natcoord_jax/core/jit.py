"""`jax.jit` whose first result does not wait for the optimising compiler, and how programs are compiled."""

import os
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import FLAG, Choice, FunctionOf, of
from natcoord_jax.core.numeric import Whole
from natcoord_jax.native.machine import set_threads
from natcoord_jax.xla.effort import Effort, set_default
from natcoord_jax.xla.jit import marked, with_marked
from natcoord_jax.xla.kept import keep

EFFORT = Choice(("tiers", "quick", "full"))
PLACES = of("a whole number, or a tuple of them", int, tuple, list)
NAMES = of("a name in quotes, or a tuple of them", str, tuple, list)


@checked()
def jit(
    function: Annotated[Any, FunctionOf("of arrays")] = None,
    *,
    effort: Annotated[Effort | None, EFFORT] = None,
    static_argnums: Annotated[int | Sequence[int], PLACES] = (),
    static_argnames: Annotated[str | Iterable[str], NAMES] = (),
    donate_argnums: Annotated[int | Sequence[int], PLACES] = (),
    donate_argnames: Annotated[str | Iterable[str], NAMES] = (),
) -> Any:
    """`jax.jit`, with the first result in seconds: least effort first, full effort meanwhile.

    The first call compiles without optimisations, which takes a half to a fifth of the time, and runs; the
    program is several times slower than it could be. From the second call on another process compiles it in
    full, and the first call after that runs as fast as by `jax.jit`. Results of both differ by rounding: ask
    for one of them where every bit has to be the same in every run. What calls back into Python (as
    `jax.pure_callback` and `jax.debug.print`) no other process can compile: it is compiled in full at once.

    Put it outermost, around the derivative: `nc.jit(jax.value_and_grad(cost))`. Within another
    transformation or another `jit` it is `jax.jit`, and so it is on other processors than the CPU.

    Unlike `jax.jit` it takes any pytree: leaves that are no arrays, as the activation of an `equinox`
    network, are static. Python numbers are arrays: one in the place of an array compiles nothing.

    Args:
        function: to be compiled. Without it, a decorator with these options.
        effort: "tiers" for both; "quick" for least effort alone, for what runs once or is tried out; "full"
            for full effort at once, for one long run. By default as `nc.set_effort` says, first "tiers".
        static_argnums: arguments, by position, that are part of the program, as in `jax.jit`.
        static_argnames: the same by name.
        donate_argnums: arguments, by position, whose memory the result may take, as in `jax.jit`.
        donate_argnames: the same by name.

    Returns:
        The function, compiled.

    Raises:
        TypeError: at a call, for a static argument that cannot be hashed.
        ValueError: for another effort, and for what is no function.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> slope = nc.jit(jax.grad(lambda x: jnp.sum(x**3)))
        >>> slope(jnp.array([1.0, 2.0])).tolist()
        [3.0, 12.0]
    """
    if function is None:
        return partial(
            jit,
            effort=effort,
            static_argnums=static_argnums,
            static_argnames=static_argnames,
            donate_argnums=donate_argnums,
            donate_argnames=donate_argnames,
        )
    statics = marked(function, static_argnums, static_argnames)
    return with_marked(function, effort, statics, marked(function, donate_argnums, donate_argnames))


@checked(effort=EFFORT)
def set_effort(effort: Effort) -> Effort:
    """Choose how much effort programs are compiled with, where it is not said at the function.

    That is for `nc.jit` without `effort`, and for what compiles when it is called from Python: `nc.simulate`,
    `nc.optimise`, and so on. What has been compiled with other effort is kept beside. The variable
    `NATCOORD_JAX_EFFORT` of the environment does the same from outside.

    Args:
        effort: "tiers" for little effort first and full effort meanwhile, see `nc.jit`; "quick" for little;
            "full" for one long run, for measurements, and where every bit has to be the same in every run.

    Returns:
        What it was before.

    Raises:
        ValueError: for anything else.

    Example:
        >>> import natcoord_jax as nc
        >>> before = nc.set_effort("full")
        >>> nc.set_effort(before)
        'full'
    """
    return set_default(effort)


@checked(number=Whole(least=0))
def native_threads(number: int = 0) -> int:
    """Choose how many threads a batch of a small system uses at most.

    Lanes of `jax.vmap` are dealt out in groups of up to eight to the threads of XLA, one for each core.
    Programs that are compiled obey at once; results are the same, to the bit. Of larger systems lanes are
    worked through one after the other, whatever is chosen.

    Args:
        number: of threads; 0 for as many as XLA has.

    Returns:
        What it was before.

    Raises:
        ValueError: for anything else.

    Example:
        >>> import natcoord_jax as nc
        >>> before = nc.native_threads(1)
        >>> nc.native_threads(before)
        1
    """
    return set_threads(int(number))


@checked(folder=of("the name of a folder, or its path", str, os.PathLike), on=FLAG)
def keep_programs(folder: str | os.PathLike | None = None, *, on: bool = True) -> Path | None:
    """Keep compiled programs, so that the next process need not compile them.

    That is JAX's own cache, with all programs in it however quickly they compiled, and beside them those that
    `nc.jit` compiles with full effort. Programs are those of one kind of processor and of one version of JAX;
    others are compiled anew. After a month they are deleted. A process that is killed leaves the folder in
    order. If JAX cannot read what it kept, it warns, and compiles.

    Args:
        folder: where; by default in the folder for such files of this user (`$XDG_CACHE_HOME`, or
            `~/.cache`). It may be shared by processes that run at the same time.
        on: `False` to keep none from now on.

    Returns:
        The folder; None if none are kept.

    Example:
        >>> import natcoord_jax as nc
        >>> import tempfile
        >>> folder = nc.keep_programs(tempfile.mkdtemp())
        >>> nc.keep_programs(on=False)
    """
    return keep(folder, on)
