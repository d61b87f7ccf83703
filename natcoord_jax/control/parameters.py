"""Numbers that are free besides the inputs, and how they act: parameters of the system."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.callables import Function
from natcoord_jax.core.kinds import FLAG, NAME, FunctionOf, Several
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.core.state import State
from natcoord_jax.system import System


class FreeNumber(Part):
    """Base of what is free besides the inputs: one number, which acts on the system or on the initial state.

    Attributes:
        name: for reports.
        lower: lower bound; None: none.
        upper: upper bound; None: none.
    """

    name: eqx.AbstractVar[str]
    lower: eqx.AbstractVar[float | None]
    upper: eqx.AbstractVar[float | None]

    @property
    def moves_geometry(self) -> bool:
        """Whether the initial state has to be assembled anew because of it."""
        return False

    @property
    def starts(self) -> bool:
        """Whether it acts on the initial state itself."""
        return False

    @property
    def given(self) -> bool:
        """Whether its first value is known before there is a motion."""
        return True

    def initial(self, system: System, state: State) -> Float[Array, ""]:
        """Value at the start of the optimisation."""
        raise NotImplementedError

    def applied(self, system: System, value: Float[Array, ""]) -> System:
        """The system with another value; the same if it does not act on it."""
        return system

    def started(self, system: System, state: State, value: Float[Array, ""]) -> State:
        """The initial state with another value; the same if it does not act on it."""
        return state


def check_room(label: str, lower: float | None, upper: float | None) -> None:
    """Refuse bounds without room between them."""
    if lower is not None and upper is not None and not lower < upper:
        raise ValueError(
            f"{label}: the lower bound {lower:g} is not below the upper bound "
            f"{upper:g}; pass bounds with room between them"
        )


class Parameter(FreeNumber):
    """A number of the system that is free: a stiffness, a mass, a length.

    Attributes:
        name: for reports.
        where: which leaf of the system, as for `eqx.tree_at`: system -> array. For more than one place,
            pass `apply` instead.
        index: place in the leaf; equal effects and bodies are stacked.
        lower: lower bound; None: none.
        upper: upper bound; None: none.
        apply: (system, value) -> system, for numbers that act in several places; needs `value`.
        value: initial value, where it cannot be read from the leaf.
        moves: whether it moves geometry, so that the initial state is assembled anew.

    Example:
        >>> import natcoord_jax as nc
        >>> mass = nc.Parameter("mass", where=lambda system: system.mass, index=(0, 0, 0), lower=1.0)
    """

    name: str = eqx.field(static=True, metadata=is_a(NAME))
    where: Callable[[System], Array] | None = eqx.field(
        default=None, kw_only=True, converter=Function.of, metadata=is_a(FunctionOf("(system) -> array"))
    )
    index: Any = eqx.field(default=(), kw_only=True, static=True, metadata=is_a(Whole() | Several(Whole())))
    lower: float | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(Number()))
    upper: float | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(Number()))
    apply: Callable[[System, Array], System] | None = eqx.field(
        default=None,
        kw_only=True,
        converter=Function.of,
        metadata=is_a(FunctionOf("(system, value) -> system")),
    )
    value: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number()))
    moves: bool = eqx.field(default=False, kw_only=True, static=True, metadata=is_a(FLAG))

    def __check_init__(self):
        """Refuse a parameter that is nowhere, or has no room."""
        if (self.where is None) == (self.apply is None) or (self.where is None and self.value is None):
            raise ValueError(f"parameter {self.name!r}: pass `where`, or `apply` together with `value`")
        check_room(f"parameter {self.name!r}", self.lower, self.upper)

    @property
    def moves_geometry(self) -> bool:
        """As `moves` says."""
        return self.moves

    def initial(self, system: System, state: State) -> Float[Array, ""]:
        """Value at the start of the optimisation."""
        if self.value is not None or self.where is None:
            return jnp.asarray(self.value, float)
        return jnp.asarray(self._leaf(system)[1])[self.index]

    def applied(self, system: System, value: Float[Array, ""]) -> System:
        """The system with another value."""
        if self.where is None:
            assert self.apply is not None
            return self.apply(system, value)
        number, leaf = self._leaf(system)
        leaves, structure = jax.tree.flatten(system)
        leaves[number] = jnp.asarray(leaf).at[self.index].set(value)
        return jax.tree.unflatten(structure, leaves)

    def _leaf(self, system: System) -> tuple[int, Array]:
        """Which leaf of the system it is a place of, and that leaf."""
        leaves, structure = jax.tree.flatten(system)
        assert self.where is not None
        number: Any = self.where(jax.tree.unflatten(structure, range(len(leaves))))
        if not isinstance(number, int):
            raise ValueError(
                f"parameter {self.name!r}: `where` gives {type(number).__name__}, which is no leaf of the "
                "system; return one of its arrays as it is, and a place in it as `index`, or pass `apply`"
            )
        return number, leaves[number]
