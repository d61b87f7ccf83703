"""Bricard's mechanism (reference case R06): six hinges in space that move although counting says they cannot.

Data as in `open_tree`, the closing joint as in `four_bar`. Five square bars along the edges of a cube between
hinges on the ground, at rest at the start.
"""

NAME = "bricard"
T_END = 2.0  # [s]
GRAVITY = (0.0, -9.81, 0.0)  # [m/s2]
POINT_SPRINGS = ()
MOTORS = ()

_CORNERS = (
    (0.0, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (1.0, -1.0, 0.0),
    (1.0, -1.0, 1.0),
    (0.0, -1.0, 1.0),
    (0.0, 0.0, 1.0),
)
_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_AXES = (_Y, _Z, _X, _Y, _Z, _X)
# Of a bar of 1 kg, 0.1 m x 0.1 m x 1 m, along its axis and across [kg m2].
_ALONG, _ACROSS = (0.1**2 + 0.1**2) / 12, (1.0 + 0.1**2) / 12


def _bar(number):
    """The bar from one corner to the next, on the hinge at its start."""
    start, end = _CORNERS[number], _CORNERS[number + 1]
    return dict(
        name=f"rod_{number + 1}",
        mass=1.0,
        inertia=tuple(_ACROSS if a == b else _ALONG for a, b in zip(start, end, strict=True)),
        com=tuple((a + b) / 2 for a, b in zip(start, end, strict=True)),
        parent=number - 1 if number else None,
        joint="revolute",
        point=start,
        axes=(_AXES[number],),
        stiffness=0.0,
        damping=0.0,
    )


BODIES = [_bar(number) for number in range(5)]
LOOPS = [
    dict(
        kind="revolute",
        body_a=None,
        body_b=4,
        point=_CORNERS[5],
        axes=(_AXES[5],),
        independent=(1, 1, 1, 1, 0, 0),
    )
]
