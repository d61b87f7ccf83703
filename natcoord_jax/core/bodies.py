"""What a scene needs to know of a body."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.eager_numpy import eager_numpy


@dataclass(frozen=True)
class NodeKind:
    """What a node carries, and what of it moves.

    A point moves along three directions; its node turns about some of its own axes besides, the first, second
    and third director. Rates are counted from that, and all forms of the equations follow it.

    A node of one's own is a body with another kind, `dataclasses.replace(nc.RigidBody(...), node=kind)`.

    Attributes:
        name: in messages.
        turns: own axes about which it turns.
        rows: vectors that it carries: its point, then directors; effects can be on these only.

    Raises:
        ValueError: for other axes or another number of rows.

    Example:
        >>> import natcoord_jax as nc
        >>> wheel = nc.NodeKind("wheel", turns=(2,), rows=4)
        >>> wheel.rates, wheel.constraints
        (4, 8)
    """

    name: str
    turns: tuple[int, ...]
    rows: int

    def __post_init__(self) -> None:
        if sorted({*self.turns} & {0, 1, 2}) != list(self.turns) or not 1 <= self.rows <= 4:
            raise ValueError(
                f"NodeKind {self.name!r}: a node turns about some of its axes 0, 1, 2, in this order, and "
                f"carries 1 to 4 rows; got turns={self.turns!r}, rows={self.rows!r}"
            )

    @property
    def rates(self) -> int:
        """Velocities of a node."""
        return 3 + len(self.turns)

    @property
    def constraints(self) -> int:
        """Constraints between its components, which all motions obey."""
        return 3 * self.rows - self.rates


POINT = NodeKind("point", (), 1)
DIRECTOR = NodeKind("director", (1, 2), 2)
TRIAD = NodeKind("triad", (0, 1, 2), 4)

NODE = (TRIAD.rows, 3)
"""Shape of the rows of a node in arrays: as those of a triad; what others do not carry is not used."""


def by_node(vectors: Float[Any, "*_ rows 3"]) -> Float[Any, "*_ nodes 4 3"]:
    """Vectors of all rows, node by node."""
    return vectors.reshape(*vectors.shape[:-2], -1, *NODE)


class Body(eqx.Module):
    """Rows and mass of a body in its assembled pose.

    Attributes:
        mass_block: m (4, 4) = [[M, e^T], [e, E]] (15).
        position: reference point phi [m].
        rotation: directors as columns [-].
        velocity: of the reference point [m/s].
        angular_velocity: world components [rad/s].
        node: what it carries and how it turns.
        shape: what to draw: something with a `surface`, or None.
        name: name, or None.
    """

    mass_block: Float[Array, "4 4"]
    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    velocity: Float[Array, "3"]
    angular_velocity: Float[Array, "3"]
    node: NodeKind = eqx.field(static=True)
    shape: Any
    name: str | None = eqx.field(static=True)

    @property
    def oriented(self) -> bool:
        """Whether it is a body that turns about all axes."""
        return self.node == TRIAD


@eager_numpy
def mass_block(mass: Float[Array, ""], centre: Float[Array, " k"], moment: Float[Array, "k k"]) -> Array:
    """Mass block (15) of a body, k = 3, or of a section of a beam, k = 2.

    Args:
        mass: or mass per length [kg or kg/m].
        centre: centre of mass from the reference point [m].
        moment: second moment about the reference point [kg m^2 or kg m].
    """
    first = mass * centre
    return jnp.block([[mass[None, None], first[None]], [first[:, None], moment]])
