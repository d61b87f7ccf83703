"""Handles: how a script refers to what it has added to a scene."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Handle:
    """A reference to a part of a scene.

    Attributes:
        kind: "body", "joint" or "effect".
        name: unique name of the part in its scene.
        scene: identity of the scene it belongs to; 0 for the ground, which every scene has.
    """

    kind: str
    name: str
    scene: int

    def __repr__(self) -> str:
        return f"<{self.kind} {self.name!r}>"


def named(part: Any) -> Any:
    """Name of a part that is given by its handle, or by name."""
    return part.name if isinstance(part, Handle) else part


ground = Handle("body", "ground", 0)
"""The inertial frame, as a body: at the origin, with the world axes as directors."""
