"""Elements of geometrically exact beams."""

from natcoord_jax.effects.beams.directors import DirectorDamping, DirectorElement
from natcoord_jax.effects.beams.relative_motion import BeamDamping, BeamElement, NonlinearBeamElement

__all__ = [
    "BeamDamping",
    "BeamElement",
    "DirectorDamping",
    "DirectorElement",
    "NonlinearBeamElement",
]
