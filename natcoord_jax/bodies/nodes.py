"""Nodes by the thousands: points, directors and triads, added to a scene as arrays under one name."""

from typing import Annotated, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.bodies import DIRECTOR, POINT, TRIAD, Body, NodeKind
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.kinds import NAME
from natcoord_jax.core.numeric import Definite, Directions, Numbers, Rotations
from natcoord_jax.maths.vectors import cross, dot

PLACES = Numbers((None, 3))
MASS = Numbers(("...",), sign="not negative")
VECTORS = Numbers(("...", 3))
ALONG, FRAMES, BLOCKS = Directions(("...", 3)), Rotations(("...", 3, 3)), Definite(("...", 4, 4))


class Nodes(eqx.Module):
    """A set of nodes of one kind in their assembled pose; made by `points`, `directors` or `triads`.

    Attributes:
        mass_blocks: m (n, 4, 4) (15) [kg, kg m, kg m^2].
        position: (n, 3) [m].
        rotation: directors as columns (n, 3, 3) [-].
        velocity: (n, 3) [m/s].
        angular_velocity: (n, 3) [rad/s].
        node: what they carry and how they turn.
        name: of the set, or None.
    """

    mass_blocks: Float[Array, "n 4 4"]
    position: Float[Array, "n 3"]
    rotation: Float[Array, "n 3 3"]
    velocity: Float[Array, "n 3"]
    angular_velocity: Float[Array, "n 3"]
    node: NodeKind = eqx.field(static=True)
    name: str | None = eqx.field(static=True)

    def body(self, number: int) -> Body:
        """One of them as a body."""
        numbers = self.mass_blocks, self.position, self.rotation, self.velocity, self.angular_velocity
        block, place, turn, drift, spin = (x[number] for x in numbers)
        return Body(block, place, turn, drift, spin, self.node, None, None)

    @staticmethod
    @checked("Nodes.points", positions=PLACES, mass=MASS, velocity=VECTORS, name=NAME)
    def points(
        positions: Any, *, mass: Any = 0.0, velocity: Any = (0.0, 0.0, 0.0), name: str | None = None
    ) -> "Nodes":
        """Points: three rates each.

        Args:
            positions: (n, 3) [m].
            mass: of each, one number or (n,) [kg]; elements bring theirs on top of it.
            velocity: (3,) or (n, 3) [m/s].
            name: of the set.

        Example:
            >>> import jax; jax.config.update("jax_enable_x64", True)
            >>> import natcoord_jax as nc
            >>> import numpy as np
            >>> nc.Nodes.points(np.zeros((1000, 3)), mass=0.1).position.shape
            (1000, 3)
        """
        place, count = as_array(positions, float), len(positions)
        blocks = _blocks(_every(mass, (count,), "mass [kg]", MASS), as_array(0.0))
        still = as_array(np.zeros((count, 3)))
        unit = as_array(np.broadcast_to(np.eye(3), (count, 3, 3)))
        moving = _every(velocity, (count, 3), "velocity [m/s]")
        return Nodes(blocks, place, unit, moving, still, POINT, name)

    @staticmethod
    @checked("Nodes.directors")
    def directors(
        positions: Annotated[Any, PLACES],
        directors: Annotated[Any, ALONG],
        *,
        mass: Annotated[Any, MASS] = 0.0,
        inertia: Annotated[Any, MASS] = 0.0,
        velocity: Annotated[Any, VECTORS] = (0.0, 0.0, 0.0),
        angular_velocity: Annotated[Any, VECTORS] = (0.0, 0.0, 0.0),
        name: Annotated[str | None, NAME] = None,
    ) -> "Nodes":
        """Points with a unit director, as shells have: five rates each, none about the director.

        Args:
            positions: (n, 3) [m].
            directors: (3,) or (n, 3) [-], of any length but zero.
            mass: of each, one number or (n,) [kg]; elements bring theirs on top of it.
            inertia: against turns of the director, one number or (n,) [kg m^2].
            velocity: (3,) or (n, 3) [m/s].
            angular_velocity: (3,) or (n, 3) [rad/s]; what turns a director about itself is left out.
            name: of the set.

        Example:
            >>> import jax; jax.config.update("jax_enable_x64", True)
            >>> import natcoord_jax as nc
            >>> import numpy as np
            >>> shell = nc.Nodes.directors(np.zeros((9, 3)), (0, 0, 1), mass=0.1, inertia=1e-5)
            >>> shell.rotation[0, :, 0].tolist()
            [0.0, 0.0, 1.0]
        """
        place, count = as_array(positions, float), len(positions)
        along = _every(directors, (count, 3), "directors [-]", ALONG)
        frames, spin = _frames(along, _every(angular_velocity, (count, 3), "angular_velocity [rad/s]"))
        turning = _every(inertia, (count,), "inertia [kg m^2]", MASS)
        blocks = _blocks(_every(mass, (count,), "mass [kg]", MASS), turning)
        moving = _every(velocity, (count, 3), "velocity [m/s]")
        return Nodes(blocks, place, frames, moving, spin, DIRECTOR, name)

    @staticmethod
    @checked("Nodes.triads")
    def triads(
        positions: Annotated[Any, PLACES],
        orientations: Annotated[Any, FRAMES],
        *,
        mass_blocks: Annotated[Any, BLOCKS],
        velocity: Annotated[Any, VECTORS] = (0.0, 0.0, 0.0),
        angular_velocity: Annotated[Any, VECTORS] = (0.0, 0.0, 0.0),
        name: Annotated[str | None, NAME] = None,
    ) -> "Nodes":
        """Points with three directors, as rigid bodies have: six rates each.

        Args:
            positions: (n, 3) [m].
            orientations: rotation matrices (3, 3) or (n, 3, 3), directors as columns.
            mass_blocks: m (4, 4) or (n, 4, 4) (15) [kg, kg m, kg m^2].
            velocity: of the reference points (3,) or (n, 3) [m/s].
            angular_velocity: (3,) or (n, 3) [rad/s].
            name: of the set.
        """
        place, count = as_array(positions, float), len(positions)
        return Nodes(
            _every(mass_blocks, (count, 4, 4), "mass_blocks [kg, kg m, kg m^2]", BLOCKS),
            place,
            _every(orientations, (count, 3, 3), "orientations [-]", FRAMES),
            _every(velocity, (count, 3), "velocity [m/s]"),
            _every(angular_velocity, (count, 3), "angular_velocity [rad/s]"),
            TRIAD,
            name,
        )


def _every(value: Any, shape: tuple[int, ...], what: str, kind: Numbers = VECTORS) -> Array:
    """One for each node.

    Raises:
        ValueError: for another number of them, naming the quantity with its unit.
    """
    given = kind.masked(as_array(value, float))
    if given.shape not in (shape, shape[1:]):
        raise ValueError(f"Nodes: {what} has shape {given.shape}; pass {shape[1:]} for all, or {shape}")
    return _broadcast(given, shape)


@eager_numpy
def _broadcast(value: Array, shape: tuple[int, ...]) -> Array:
    return jnp.broadcast_to(value, shape)


@eager_numpy
def _blocks(mass: Float[Array, " n"], inertia: Float[Array, "*n"]) -> Float[Array, "n 4 4"]:
    """Mass blocks of points with a director."""
    blocks = jnp.zeros((mass.shape[0], 4, 4)).at[:, 0, 0].set(mass)
    return blocks.at[:, 1, 1].set(inertia)


@eager_numpy
def _frames(
    directors: Float[Array, "n 3"], spin: Float[Array, "n 3"]
) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]:
    """Triads as columns whose first axis is the director, and angular velocities normal to it."""
    first = directors / jnp.sqrt(jnp.sum(directors**2, axis=1, keepdims=True))
    # The world axis that is least aligned with it.
    least = jnp.argmin(jnp.abs(first), axis=1)
    helper = jnp.eye(3)[least]
    second = helper - dot(helper, first)[:, None] * first
    second = second / jnp.sqrt(jnp.sum(second**2, axis=1, keepdims=True))
    frames = jnp.stack([first, second, cross(first, second)], axis=2)
    return frames, spin - dot(spin, first)[:, None] * first
