"""Compilation that is quicker where a function is called from Python."""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, TypeVar

import equinox as eqx
import jax

from natcoord_jax.core.checks import at_top_level
from natcoord_jax.core.closures import with_callables

QUICK = {"xla_cpu_use_fusion_emitters": False}
"""Option of the CPU compiler of JAX 0.10: a third less time to compile, for programs that run as fast. JAX
accepts options at the outermost call only."""

BRIEF = QUICK | {"xla_backend_optimization_level": 0}
"""Options for programs that are run once or a few times: half the time to compile, and slower by as much as
ten times, which are milliseconds. Who runs one often wraps it in `jax.jit`, where these do not apply."""

F = TypeVar("F", bound=Callable[..., Any])


def accepted(options: dict[str, Any]) -> dict[str, Any]:
    """Those options that the compiler has: they come and go with its versions. None but on the CPU."""
    on_cpu = jax.default_backend() == "cpu"
    return {name: value for name, value in options.items() if on_cpu and _is_known(name, value)}


@cache
def _is_known(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda: 0, compiler_options={name: value})()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def compiled(function: F) -> F:
    """`eqx.filter_jit` of a function whose callables are seen anew at each call, see `closures`."""
    return _with({}, function)


def quickly(function: F) -> F:
    """The same, but it compiles quicker at the outermost call; JAX accepts options only there."""
    return _with(QUICK, function)


def briefly(function: F) -> F:
    """The same for a function that is run once or a few times: it compiles quicker still, and runs slower."""
    return _with(BRIEF, function)


def _with(options: dict[str, Any], function: F) -> F:
    within = eqx.filter_jit(function)

    @cache
    def outermost() -> Callable:
        known = accepted(options)
        if not known:
            return within
        return eqx.filter_jit(function, compiler_options=known)  # pyright: ignore[reportCallIssue]

    def run(*arguments: Any) -> Any:
        quick = at_top_level(eqx.filter(arguments, eqx.is_array))
        return (outermost() if quick else within)(*arguments)

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return with_callables(function, run, arguments)

    return call  # pyright: ignore[reportReturnType]
