"""Whether something is being traced."""

from typing import Any

import jax
from jax.core import Tracer, eval_context
from jax.extend.core import get_opaque_trace_state


def is_concrete(*values: Any) -> bool:
    """Whether none of the values is being traced."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


with eval_context():
    TOP_LEVEL = get_opaque_trace_state()
    """State of JAX outside of all transformations, even if this is imported inside of one."""


def at_top_level(*values: Any) -> bool:
    """Whether nothing is being traced: neither the values nor the function around them."""
    return get_opaque_trace_state() == TOP_LEVEL and is_concrete(values)
