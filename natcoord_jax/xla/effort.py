"""Programs that are compiled with least effort first, and with full effort while these run.

XLA takes a dozen seconds to compile the gradient of a small system, and most of that are optimisations.
Without them the first result is there much sooner, and programs run several times slower: nobody notices as
long as they run a few times. What is run a second time is compiled in full by another process, and takes over
when that is done.
"""

import os
import warnings
import weakref
from collections.abc import Callable, Hashable, Sequence
from functools import cache, partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from natcoord_jax.xla.elsewhere import Compilation, elsewhere
from natcoord_jax.xla.kernels import without_kernels
from natcoord_jax.xla.rewriting import inner_programs
from natcoord_jax.xla.tracing import at_once, at_top_level, in_lanes
from natcoord_jax.xla.waiting import told

Effort = Literal["tiers", "quick", "full"]
"""How much effort to compile with: little first and then full, little, or full."""

FULL = {"xla_cpu_use_fusion_emitters": False}
"""Option of the CPU compiler of JAX 0.10: a third less time to compile, for programs that run as fast. JAX
accepts options at the outermost call only."""

LOOPS = "while-loop-invariant-code-motion", "simplify-while-loops", "while-loop-trip-count-annotator"
"""Passes over loops, whose time grows with the square of their number: two fifths of what is left without
optimisations, for a tenth of the time that programs take then."""

LEAST = FULL | {"xla_backend_optimization_level": 0, "xla_disable_hlo_passes": ",".join(LOOPS)}
"""Options for programs that are run once or a few times: a fifth of the time to compile, and slower by as
much as ten times, which are milliseconds."""

SETTINGS = (
    "jax_enable_x64",
    "jax_default_device",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
)
"""Settings of JAX by which a program may differ."""

LOOKING = "jax_disable_jit", "jax_debug_nans", "jax_debug_infs"
"""Settings of JAX by which it looks into programs, as only its own can be looked into."""


def accepted(options: dict[str, Any]) -> dict[str, Any]:
    """Those options that the compiler has: they come and go with its versions. None but on the CPU."""
    if jax.default_backend() != "cpu":
        return {}
    every = tuple(options.items())
    return dict(every if _are_known(every) else [one for one in every if _are_known((one,))])


@cache
def _are_known(options: tuple[tuple[str, Any], ...]) -> bool:
    try:
        jax.jit(lambda: 0, compiler_options=dict(options))()
    except jax.errors.JaxRuntimeError:
        return False
    return True


VARIABLE = "NATCOORD_JAX_EFFORT"
"""Of the environment, where it is not to be written into the program."""


def _of_environment() -> Any:
    effort = os.environ.get(VARIABLE, "tiers")
    if effort not in get_args(Effort):
        raise ValueError(f"{VARIABLE} in the environment is {effort!r}; set {' or '.join(get_args(Effort))}")
    return effort


_default: list[Effort] = [_of_environment()]


def set_default(effort: Effort) -> Effort:
    """Choose the effort where none is given; returns what it was before."""
    before = _default[0]
    _default[:] = [effort]
    return before


class Program:
    """A program, compiled with as much effort as it is worth.

    Args:
        function: of arrays whose memory it may use again, and of others, to arrays and what else it returns.
        name: of the function.
        shapes: of the arrays.
        effort: how.
    """

    def __init__(self, function: Callable, name: str, shapes: tuple[list, list], effort: Effort):
        made: list[Any] = []

        def flat(donated: list, kept: list) -> Any:
            arrays, rest = function(donated, kept)
            made.append(rest)
            return arrays

        flat.__name__ = flat.__qualname__ = self.name = name
        jitted, differ = jax.jit(flat, donate_argnums=0), accepted(FULL) != accepted(LEAST)
        tiers = effort == "tiers" and differ and not _holds(jitted.trace(*shapes).jaxpr.jaxpr, "native")
        source = _exported(jitted, shapes) if tiers else None
        quick = differ and (effort == "quick" or source is not None)
        whole = jitted if source is None else jax.jit(source.call, donate_argnums=0)
        lowered = whole.lower(*shapes)
        lowered = without_kernels(lowered) if quick else lowered
        self.run: Callable = lowered.compile(accepted(LEAST if quick else FULL))
        self.rest = made[0]
        self._again = None if source is None else Compilation(source, shapes, accepted(FULL))
        self._calls = 0

    def __call__(self, *arguments: Any) -> Any:
        """What it computes."""
        self._calls += 1
        if self._again is not None:
            if self._calls == 2:
                elsewhere.compile(self._again)
            if self._again.answer is not None:
                self._take_over(self._again)
        return self.run(*arguments), self.rest

    def _take_over(self, again: Compilation) -> None:
        self._again = None
        try:
            self.run = again.loaded()
        except Exception as error:  # (Whatever it is: the program at hand goes on.)
            warnings.warn(f"{self.name} stays compiled with least effort: {error}", stacklevel=4)


def _holds(jaxpr: Any, name: str) -> bool:
    """Whether an operation is in a program: machine code of our own, say, beside which there is little."""
    return any(
        equation.primitive.name == name or any(_holds(x, name) for x in inner_programs(equation))
        for equation in jaxpr.eqns
    )


def _exported(jitted: Any, shapes: tuple[list, list]) -> export.Exported | None:
    """What another process can compile; None for what calls back into Python, or cannot be traced."""
    try:
        return export.export(jitted)(*shapes)
    except Exception:
        return None


class Programs:
    """The programs of a function: one for each kind of arguments.

    Args:
        name: of the function.
        function: of something hashable, of arrays whose memory it may use again, and of others, to arrays and
            what else it returns, a pytree without leaves.
        effort: how they are compiled; None for as `set_effort` says at the first call.
    """

    def __init__(self, name: str, function: Callable, effort: Effort | None):
        def within(static: Any, donated: list, kept: list) -> Any:
            return function(static, donated, kept)

        within.__name__ = within.__qualname__ = name
        self.name, self.function = name, function
        self.effort: Effort | None = effort
        self.within = jax.jit(within, static_argnums=0, donate_argnums=1)
        self.known: dict[Hashable, Program] = {}
        self.of_lanes: dict[tuple, Programs] = {}
        _every.add(self)

    def __call__(self, static: Hashable, donated: list[Any], kept: list[Any]) -> Any:
        """Value of the function."""
        arrays = [*donated, *kept]
        if any(getattr(jax.config, name) for name in LOOKING):
            return self.within(static, *([jnp.asarray(x) for x in given] for given in (donated, kept)))
        if not donated and in_lanes(arrays):
            return self._of_lanes(static, kept)
        if not at_top_level(arrays) or not _alone(arrays):
            return self.within(static, donated, kept)
        effort: Any = self.effort or _default[0]
        if _mark._cache_size() == 0:  # pyright: ignore[reportAttributeAccessIssue]
            forget()
            _mark()
        settings = tuple(getattr(jax.config, name) for name in SETTINGS)
        key = effort, static, _kinds(donated), _kinds(kept), settings
        program = self.known.get(key)
        if program is None:
            shapes = _shapes(donated), _shapes(kept)
            with told(self.name):
                program = Program(partial(self.function, static), self.name, shapes, effort)
            self.known[key] = program
        return program(donated, kept)

    def _of_lanes(self, static: Hashable, kept: list[Any]) -> Any:
        """Within `jax.vmap`, outside of all else: one program of all lanes, compiled as any other."""
        made: list[Any] = []

        def every(arrays: Sequence[Any], axes: tuple) -> list[Any]:
            if axes not in self.of_lanes:

                def lanes(static: Any, donated: list, kept: list) -> Any:
                    return jax.vmap(partial(self.function, static, donated), in_axes=(list(axes),))(kept)

                self.of_lanes[axes] = Programs(self.name, lanes, self.effort)
            found, rest = self.of_lanes[axes](static, [], list(arrays))
            made.append(rest)
            return found

        return at_once(every, kept), made[0]


_every: weakref.WeakSet[Programs] = weakref.WeakSet()


_mark = jax.jit(lambda: 0)
"""A program of JAX, which `jax.clear_caches` gives up with all others, and ours have to go with it."""


def forget() -> None:
    """Give up all programs."""
    for programs in _every:
        programs.known.clear()


def _kinds(arrays: Sequence[Any]) -> tuple:
    return tuple((x.shape, x.dtype) for x in arrays)


def _shapes(arrays: Sequence[Any]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays]


def _alone(arrays: Sequence[Any]) -> bool:
    """Whether all arrays are where programs run by default."""
    if jax.local_device_count() == 1:
        return True
    here = jax.config.jax_default_device or jax.local_devices()[0]  # pyright: ignore[reportAttributeAccessIssue]
    return all(isinstance(x, np.ndarray | np.generic) or x.devices() == {here} for x in arrays)
