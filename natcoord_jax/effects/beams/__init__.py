"""Elements of geometrically exact beams."""

from natcoord_jax.effects.beams.directors import DirectorDamping as DirectorDamping
from natcoord_jax.effects.beams.directors import DirectorElement as DirectorElement
from natcoord_jax.effects.beams.relative_motion import BeamDamping as BeamDamping
from natcoord_jax.effects.beams.relative_motion import BeamElement as BeamElement
from natcoord_jax.effects.beams.relative_motion import NonlinearBeamElement as NonlinearBeamElement
