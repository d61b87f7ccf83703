"""A fast top on a ball joint (reference case R01): data in the format of `open_tree`."""

NAME = "heavy_top"
T_END = 0.5  # [s]
GRAVITY = (0.0, 0.0, -9.81)  # [m/s2]
POINT_SPRINGS = ()
MOTORS = ()
BODIES = [
    dict(
        name="top",
        mass=15.0,
        inertia=(0.234375, 0.46875, 0.234375),
        com=(0.0, 1.0, 0.0),
        parent=None,
        joint="spherical",
        point=(0.0, 0.0, 0.0),
        axes=(),
        stiffness=0.0,
        damping=0.0,
        angular_velocity=(0.0, 150.0, -4.61538),
    )
]
