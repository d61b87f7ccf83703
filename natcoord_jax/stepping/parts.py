"""How the parts of a loop are compiled: together, or each as one kernel of its own.

What is compiled as one kernel becomes one function of machine code, whose time to compile grows faster than
its size: ten thousand operations take half as long in three parts. Between the parts nothing but arrays can
travel, and each of them costs several calls. So what they hand on is held in one array, apart from what is
large.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.stepping.one_kernel import PACKED_UP_TO, apart, as_one_kernel, in_one_array


class Held(eqx.Module):
    """A pytree in one array, apart from its large ones.

    Attributes:
        small: all small arrays.
        large: those with more than `PACKED_UP_TO` numbers.
        kinds: shape and type of each array.
        structure: of the pytree.
    """

    small: Float[Array, "*lanes _"]
    large: list[Array]
    kinds: tuple[tuple[tuple[int, ...], Any], ...] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    @classmethod
    def of(cls, tree: Any) -> "Held":
        """Hold a pytree of arrays."""
        leaves, structure = jax.tree.flatten(tree)
        leaves = [jnp.asarray(x) for x in leaves]
        kinds = tuple((x.shape, x.dtype) for x in leaves)
        small = in_one_array([x for x in leaves if x.size <= PACKED_UP_TO])
        return cls(small, [x for x in leaves if x.size > PACKED_UP_TO], kinds, structure)

    @property
    def tree(self) -> Any:
        """The pytree."""
        alone = [math.prod(shape) > PACKED_UP_TO for shape, _ in self.kinds]
        small = iter(apart(self.small, [kind for kind, large in zip(self.kinds, alone) if not large]))
        large = iter(self.large)
        return jax.tree.unflatten(self.structure, [next(large if x else small) for x in alone])


class Together:
    """Parts that are compiled together."""

    @staticmethod
    def hold(tree: Any) -> Any:
        """What parts hand on, as it is."""
        return tree

    @staticmethod
    def read(held: Any) -> Any:
        """What is held."""
        return held

    @staticmethod
    def call(function: Callable[..., tuple], *held: Any) -> tuple:
        """The values of a function of what is held."""
        return function(*held)


class Apart:
    """Parts that are compiled as one kernel each; single arrays are handed on as they are."""

    @staticmethod
    def hold(tree: Any) -> Any:
        """What parts hand on."""
        return tree if tree is None or isinstance(tree, jax.Array) else Held.of(tree)

    @staticmethod
    def read(held: Any) -> Any:
        """What is held."""
        return held.tree if isinstance(held, Held) else held

    @staticmethod
    def call(function: Callable[..., tuple], *held: Any) -> tuple:
        """The values of a function of what is held, each of them held again."""

        def part(*held: Any) -> tuple:
            return tuple(map(Apart.hold, function(*map(Apart.read, held))))

        return as_one_kernel(part, *held)
