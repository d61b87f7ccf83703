"""Contact of many capsules and spheres, that look for their neighbours instead of listing all pairs."""

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from natcoord_jax.bodies.contact_sides import Side
from natcoord_jax.bodies.shapes import Capsule, Sphere
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import stacked
from natcoord_jax.core.handles import Handle
from natcoord_jax.effects.contact.capsules import CapsuleContacts

MANY = 50
"""Bodies from which on neighbours are looked for."""


def are_searched(sides: Sequence[Side], law: dict[str, Any], search: dict[str, Any], name: str) -> bool:
    """Whether neighbours are looked for.

    Args:
        sides: that are in contact each with each.
        law: numbers of the contact.
        search: numbers of the search that are given.
        name: of the contact, for messages.

    Raises:
        ValueError: where that is asked for, but is not possible.
    """
    missing = what_a_search_wants(sides, law)
    if search and missing:
        raise ValueError(
            f"contact {name!r}: capacity and skin [m] are of a search for neighbours, which there is of "
            f"spheres, capsules and points with a stiffness [N/m] and without friction; {missing}, or leave "
            "them out, and all pairs are listed"
        )
    return not missing and (bool(search) or len(sides) >= MANY)


def what_a_search_wants(sides: Sequence[Side], law: dict[str, Any]) -> str:
    """What is to be changed before neighbours can be looked for; nothing where they can.

    A force of friction is an unknown of its own while it is there, and what stops slip at the end of a step
    sees all contacts at once: both want equations whose number changes from step to step.

    Args:
        sides: that are in contact each with each.
        law: numbers of the contact.
    """
    strange = next((side for side in sides if side.kind not in (Sphere, Capsule)), None)
    wants = [] if strange is None else [f"make {strange.named} of spheres and capsules"]
    wants += ["pass `stiffness` [N/m]"] if law["stiffness"] is None else []
    wants += ["leave out `friction` [-]"] if "friction" in law else []
    return ", ".join(wants)


def searched_contacts(
    sides: Sequence[Any],
    pairs: Sequence[tuple[Handle, Handle]],
    law: dict[str, Any],
    search: dict[str, Any],
    name: str,
) -> CapsuleContacts:
    """Their contact.

    Args:
        sides: spheres, capsules and points.
        pairs: that may touch.
        law: numbers of the contact.
        search: numbers of the search that are given.
        name: of the contact.

    Raises:
        ValueError: for nothing but points, and options of other contacts.
    """
    radii = [as_array(side.radius, float) for side in sides]
    strange = law.keys() - {"stiffness", "law", "restitution", "speed"}
    if strange:
        raise ValueError(
            f"contact {name!r}: {min(strange)} is no option of spheres and capsules; leave it out"
        )
    if all(isinstance(side.radius, float) and side.radius == 0.0 for side in sides):
        raise ValueError(f"contact {name!r}: points do not overlap; give some of the bodies a shape")
    number, kept = {side.handle: k for k, side in enumerate(sides)}, {frozenset(pair) for pair in pairs}
    ignored = [(number[a], number[b]) for a, b in combinations(number, 2) if frozenset((a, b)) not in kept]
    ends = 1 if all(side.kind is Sphere for side in sides) else 2
    return CapsuleContacts(
        tuple(side.ends[k] for k in range(ends) for side in sides),
        radii=stacked(radii),
        ignored=np.array(ignored, float).reshape(-1, 2),
        name=name,
        **law,
        **search,
    )
