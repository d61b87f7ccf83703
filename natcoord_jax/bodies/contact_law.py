"""Which effect keeps a gap of a contact open, by the numbers that the contact was given."""

from typing import Any

import numpy as np

from natcoord_jax.bodies.contact_sides import SegmentSide, Side
from natcoord_jax.core.markers import Marker
from natcoord_jax.effects.contact import (
    FrictionalGapPotential,
    Gap,
    GapConstraint,
    GapPotential,
    SphereOnPlane,
)

Law = dict[str, Any]

OF_SOME = {
    "rounding": "the edges of two boxes",
    **dict.fromkeys(("candidates", "one_pass", "method"), "two surfaces"),
}
"""Options that contacts of other sides have no use for, and whose they are."""

OF_CONSTRAINTS = "restitution", "friction"
"""Options of contacts without a stiffness."""


def kept_open(gap: Gap, markers: tuple[Marker, ...], law: Law, name: str, *sides: Side) -> Any:
    """A potential with the stiffness that is given or that of the sides; a constraint where there is none.

    Args:
        gap: of the markers.
        markers: as the gap takes them.
        law: numbers and options of the contact.
        name: of the contact, for messages.
        *sides: that are in contact.

    Raises:
        ValueError: for options that the sides have no use for, and numbers that do not go together.
    """
    law = dict(law)
    for option in OF_SOME.keys() & law:
        raise ValueError(f"contact {name!r}: {option} is an option of {OF_SOME[option]}; leave it out")
    balls = [s for s in sides if isinstance(s, SegmentSide)]
    own = [s.stiffness for s in balls if s.stiffness is not None]
    given = law.pop("stiffness")
    stiffness = given if given is not None else min(own, default=None)
    if stiffness is not None and "friction" in law:
        # A node does not turn, or not about its director: what rubs at another place than it would be lost.
        if own and (any(np.asarray(s.radius) > 0 for s in balls) or not isinstance(gap, SphereOnPlane)):
            raise ValueError(
                f"contact {name!r}: there is no friction [-] on nodes of shells and solids yet but those of "
                "solids on planes; leave it out"
            )
        return _called(name, FrictionalGapPotential, markers, gap, stiffness=stiffness, **law)
    if stiffness is not None:
        return _called(name, GapPotential, markers, gap, stiffness=stiffness, **law)
    if "speed" in law or law["law"] != "linear":
        raise ValueError(
            f"contact {name!r}: speed [m/s] and law are of contacts with a stiffness [N/m]; pass "
            "`stiffness`, or leave them out"
        )
    return _called(name, GapConstraint, markers, gap, **{k: law[k] for k in OF_CONSTRAINTS if k in law})


def _called(name: str, kind: type, *given: Any, **law: Any) -> Any:
    """An effect of a contact, which is what its refusals name."""
    try:
        return kind(*given, **law)
    except ValueError as error:
        raise ValueError(f"contact {name!r}: {str(error).removeprefix(f'{kind.__name__}: ')}") from None
