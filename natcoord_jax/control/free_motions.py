"""Names of the free motions of a system."""

import numpy as np

from natcoord_jax.model.tree import SLOTS
from natcoord_jax.system import System


def owners(system: System) -> list[str]:
    """Name of the body each free motion belongs to."""
    return [system.structure.bodies[int(k)] for k in np.asarray(system.tree.slot_of) // SLOTS]
