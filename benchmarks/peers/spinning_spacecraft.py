"""The spacecraft of `spacecraft`, turning as a whole at the start.

From rest its base turns about a fixed axis, which codes in minimal coordinates follow exactly at any step.
"""

from benchmarks.peers.spacecraft import BODIES as RESTING
from benchmarks.peers.spacecraft import GRAVITY as GRAVITY
from benchmarks.peers.spacecraft import MOTORS as MOTORS
from benchmarks.peers.spacecraft import POINT_SPRINGS as POINT_SPRINGS
from benchmarks.peers.spacecraft import T_END as T_END

NAME = "spinning_spacecraft"
SPIN = (0.3, -0.2, 0.5)  # [rad/s], about the centre of the base
BODIES = [body | {"angular_velocity": SPIN} for body in RESTING]
