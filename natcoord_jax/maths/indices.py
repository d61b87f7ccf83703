"""Arrays of indices that are part of a program: whatever is traced, their numbers are known."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


class _Computed(np.ndarray):
    """What is taken from indices: an array of NumPy as any other, that goes with traced indices too."""

    def __getitem__(self, key: Any) -> Any:
        if any(isinstance(x, jax.Array) for x in (key if isinstance(key, tuple) else (key,))):
            return jnp.asarray(np.asarray(self))[key]
        return super().__getitem__(key)

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return array[()] if return_scalar else array.view(_Computed)


class Indices(_Computed):
    """A constant array of whole numbers or truth values, as the structure of a pytree: a node without leaves.

    So programs are told apart by its content, and know it: within `jax.jit`, `jax.vmap` or `jax.grad` of a
    module that has it as a field it is the same array of NumPy. What is computed from it, its slices
    included, is an array as any other. Handed on by itself to a function that is mapped or scanned it is no
    lane but the whole: there `numpy.asarray` makes a leaf of it.
    """

    _content: "_Content"

    @classmethod
    def of(cls, values: Any) -> Any:
        """An array, or arrays in a tuple, as indices; None as it is."""
        if isinstance(values, tuple):
            return tuple(map(cls.of, values))
        if values is None or isinstance(values, cls):
            return values
        found = np.array(values).view(cls)
        found.flags.writeable = False
        found.__class__ = cls
        found._content = _Content(found)
        return found

    def __array_finalize__(self, whole: Any) -> None:
        if whole is not None:
            self.__class__ = _Computed  # pyright: ignore[reportAttributeAccessIssue]

    def __reduce__(self) -> Any:
        return Indices.of, (np.asarray(self),)

    def __deepcopy__(self, memo: Any) -> Any:
        return self

    def __hash__(self) -> int:  # of modules that are static arguments
        return hash(self._content)


class _Content:
    """What indices are compared and hashed by."""

    def __init__(self, array: Indices):
        self.array = array
        self._hash = hash((array.shape, array.dtype.str, array.tobytes()))

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if self is other or not isinstance(other, _Content):
            return self is other
        one, two = self.array, other.array
        return self._hash == other._hash and one.dtype == two.dtype and np.array_equal(one, two)

    def __repr__(self) -> str:
        return repr(np.asarray(self.array))


jax.tree_util.register_pytree_node(Indices, lambda x: ((), x._content), lambda content, _: content.array)

INDICES: dict[str, Any] = {"converter": Indices.of}
"""What `eqx.field` says of a field that holds them."""
