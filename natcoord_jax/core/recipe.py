"""Recipes: parts of a scene that consist of several bodies, joints and effects."""

import abc
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Float

from natcoord_jax.core.arguments import Part
from natcoord_jax.core.bodies import Body
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.nodes import NodeSet


@runtime_checkable
class Builder(Protocol):
    """What a recipe may do to the scene that it is added to."""

    def add(self, part: Any) -> Any:
        """Add a part; its handle."""
        ...

    def find(self, handle: Handle, user: str = ...) -> Any:
        """The part behind a handle; None for the ground."""
        ...

    def joined(self, one: Handle, other: Handle) -> bool:
        """Whether a joint that was added before is between two bodies."""
        ...

    def move_nodes(self, nodes: NodeSet, positions: Any) -> None:
        """Put some nodes of a set elsewhere in the assembled pose."""
        ...

    def add_mass(self, handle: Handle, block: Float[Array, "4 4"]) -> None:
        """Add a mass block (15), in the body's own frame, to that of a body."""
        ...


class Recipe(Part):
    """Base of parts that add bodies, joints and effects to a scene."""

    kind = "recipe"

    def at(self, **placement: Any) -> "Recipe":
        """The recipe under another name or at another place, see `Scene.add`.

        Raises:
            ValueError: for one that says itself where its parts are.
        """
        given = " and ".join(placement)
        raise ValueError(
            f"Scene.add: {given} for a {self.kind}, which has its name and its places itself; "
            "pass them to the part, or a robot of nc.io.load"
        )

    @abc.abstractmethod
    def add_to(self, scene: Builder, name: str) -> Any:
        """Add everything under names that start with `name`; returns what refers to it."""


def pose_of(scene: Builder, handle: Handle, user: str) -> Body | None:
    """The body behind a handle, None for the ground.

    Raises:
        ValueError: for a handle of another scene or of something else.
    """
    part = scene.find(handle, user)
    if part is not None and not isinstance(part, Body):
        raise ValueError(f"{user}: {handle!r} is no body; pass the handle of a body or nc.ground")
    return part
