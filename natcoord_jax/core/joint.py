"""Joints: constraints between a frame of a parent body and a frame of a child body.

At assembly both frames coincide (44-47): the point of the joint and a triad whose third axis is the axis
of the joint. A joint gives the residual of its constraints, at most quadratic in the frames; joints of
the library also say which relative motions stay free, so that a spanning tree of them needs no multipliers.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import equations
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import BODY, NAME
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.numeric import COMPONENTS, Directions


class Frame(eqx.Module):
    """A joint's point and triad as carried by one body.

    Attributes:
        point: [m].
        axes: the three vectors, one a row; orthonormal at the ends of a step, not in between.
    """

    point: Float[Array, "*s 3"]
    axes: Float[Array, "*s 3 3"]


def frames_at(place: Float[Array, "2 4 4"], rows: Float[Array, "*s 2 4 3"]) -> tuple[Frame, Frame]:
    """Frames of parent and child from their rows; place[b] = weights of (point, axis 1, 2, 3) of body b."""
    vectors = jnp.sum(place[..., None] * rows[..., None, :, :], axis=-2)
    points, axes = jnp.split(vectors, [1], axis=-2)
    (parent, child), (parent_axes, child_axes) = (jnp.unstack(x, axis=-3) for x in (points, axes))
    return Frame(parent[..., 0, :], parent_axes), Frame(child[..., 0, :], child_axes)


class Joint(Effect):
    """Base of joints: subclass it and give `residual` (and `multipliers`, its length).

    Attributes:
        parent: body handle, or `ground`.
        child: body handle, or `ground`.
        point: shape (3,) [m], world coordinates of the assembled pose; default the child's reference point.
        axis: shape (3,) [-], world coordinates of the assembled pose: the third axis of both frames.
        second: shape (3,) [-], where the first axis of both frames points; default: any perpendicular.
        name: optional name.

    Class attributes:
        multipliers: number of constraints.
        rotations: axes of the parent's frame about which the child may turn freely.
        child_rotation: the child may also turn about the first axis of its own frame.
        translations: axes of the parent's frame along which the child may slide freely.
        free: whether `rotations` and `translations` describe the free motion completely, so that the
            joint may be part of the spanning tree; False keeps its multipliers.
        coordinates: the joint's coordinates, in the order sensors and drives count them.
        assembling: fields that only the assembled pose takes, and a compiled system does not have.
        apart: whether parent and child have points of their own, by default their reference points; else both
            have one, by default the child's reference point.

    Example:
        A joint of one's own, a point that stays in a plane through the joint:

        >>> import natcoord_jax as nc
        >>> class PointInPlane(nc.Joint):
        ...     multipliers = 1
        ...     def residual(self, parent, child):
        ...         return (parent.axes[2] @ (child.point - parent.point))[None]
    """

    parent: Any = eqx.field(metadata=is_a(BODY))
    child: Any = eqx.field(metadata=is_a(BODY))
    point: Any = eqx.field(default=None, kw_only=True, metadata=is_a(COMPONENTS))
    axis: Any = eqx.field(default=(0.0, 0.0, 1.0), kw_only=True, metadata=is_a(Directions()))
    second: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Directions()))
    name: Any = eqx.field(default=None, kw_only=True, metadata=is_a(NAME))

    kind: ClassVar[str] = "joint"
    impulsive: ClassVar[bool] = True
    multipliers: ClassVar[int] = 0
    rotations: ClassVar[tuple[int, ...]] = ()
    child_rotation: ClassVar[bool] = False
    translations: ClassVar[tuple[int, ...]] = ()
    free: ClassVar[bool] = False
    coordinates: ClassVar[tuple[Any, ...]] = ()
    assembling: ClassVar[tuple[str, ...]] = ("parent", "child", "point", "axis", "second", "name")
    apart: ClassVar[bool] = False

    @abc.abstractmethod
    def residual(self, parent: Frame, child: Frame) -> Float[Array, " m"]:
        """Constraints g, at most quadratic in the vectors of the two frames."""

    def anchors(self) -> tuple[Any, Any]:
        """Points of parent and child [m] in the assembled pose; None: see `apart`."""
        return self.point, self.point

    def zeroed(self, triad: Float[Array, "3 3"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """The parent's triad in the assembled pose, and how far its point is from the joint's [m].

        Coordinates count from where both frames coincide: from the assembled pose, unless a joint says else.
        """
        return triad, jnp.zeros(3)

    def assembled(self, coordinate: int) -> Any:
        """The angle that a coordinate has in the assembled pose [rad], counted on over many turns."""
        return 0.0

    def initialise(self, parent: Frame, child: Frame) -> "Joint":
        """This joint with the numbers it takes from the assembled pose."""
        return self

    def companions(self, handle: Handle) -> list[Effect]:
        """Effects that come with the joint, such as the pitch relation of a screw, by its numbers.

        Made anew where these are set in a system.
        """
        return []

    def quadratic(self, place: Array, rows: Array) -> Array:
        """The residual."""
        return equations(self.residual(*frames_at(place, rows)), self, "residual")

    def violation(self, place: Array, rows: Array, coordinates: Array, t: Array) -> Array:
        """The residual."""
        return self.quadratic(place, rows)

    def violation_rate(
        self, place: Array, rows: Array, rates: Array, spin: Array, t: Array, passing: Any
    ) -> Array:
        """That of the residual."""
        rate = jax.jvp(lambda x: self.residual(*frames_at(place, x)), (rows,), (rates,))[1]
        return equations(rate, self, "residual")

    def violation_units(self, place: Array, rows: Array) -> tuple[str, ...]:
        """Metres where a constraint depends on where the points are."""
        parent, child = frames_at(place, rows)

        def from_points(points: Array) -> Array:
            return self.residual(Frame(points[0], parent.axes), Frame(points[1], child.axes))

        change = jax.jacfwd(from_points)(jnp.stack([parent.point, child.point]))
        return tuple("m" if np.any(x) else "-" for x in np.asarray(change))

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """Rates G(Q_i) V_i: for quadratic g the discrete derivative (57); and forces G^T lambda_i."""

        def constraint(rows: Float[Array, "2 4 3"]) -> Float[Array, " m"]:
            return self.residual(*frames_at(place, rows))

        def stage(rows, rates, held, multiplier):
            g_rate = jax.jvp(constraint, (rows,), (rates,))[1]
            return equations(g_rate, self, "residual"), jax.vjp(constraint, held)[1](multiplier)[0]

        g_rates, forces = jax.vmap(stage)(motion.rows, motion.rates, motion.held.rows, lam)
        return Response(forces, None, g_rates, jnp.zeros(now.tableau.stages))
