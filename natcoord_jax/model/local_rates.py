"""The rates of nodes in local equations: six of a triad, five of a director, three of a point.

A twist is the velocity of a node and its angular velocity. A director does not turn about itself, a point
does not turn at all; what is left of their twists are their rates, which are the unknowns. The angular
velocity of a director is taken along its axes at the start of the step, so that one component of it vanishes.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.bodies import TRIAD, NodeKind
from natcoord_jax.maths.indices import INDICES

TWIST = 6
"""Components of a twist."""


class LocalRates(eqx.Module):
    """Which components of the twists of all nodes are unknown; for triads alone there are no leaves.

    Attributes:
        place: rate of each component of the twists, `count` where there is none; None: they are the same.
        component: component of each rate among those of all twists; None: they are the same.
        directed: nodes whose angular velocity is taken along their own axes; None: there are none.
        bodies: number of nodes.
        count: number of rates.
    """

    place: Int[np.ndarray, "bodies 6"] | None = eqx.field(**INDICES)
    component: Int[np.ndarray, " count"] | None = eqx.field(**INDICES)
    directed: Int[np.ndarray, " directors"] | None = eqx.field(**INDICES)
    bodies: int = eqx.field(static=True)
    count: int = eqx.field(static=True)

    @classmethod
    def of(cls, kinds: Sequence[NodeKind]) -> "LocalRates":
        """Of nodes of these kinds; on the host."""
        bodies = len(kinds)
        if all(kind == TRIAD for kind in kinds):
            return cls(None, None, None, bodies, TWIST * bodies)
        turning = np.array([[k in kind.turns for k in TRIAD.turns] for kind in kinds])
        present = np.concatenate([np.ones_like(turning), turning], axis=1)
        count = int(present.sum())
        place = np.full(present.shape, count, np.int32)
        place[present] = np.arange(count)
        directed = np.flatnonzero(turning.any(axis=1) & ~turning.all(axis=1)).astype(np.int32)
        component = np.flatnonzero(present).astype(np.int32)
        return cls(place, component, directed if directed.size else None, bodies, count)

    def places(self, stages: int, absent: int, xp: Any = jnp) -> Int[Array | np.ndarray, "nodes s 6"]:
        """Unknown of each component of the twists of all bodies and the ground; `absent` where there is none.

        Args:
            stages: of the collocation method.
            absent: what stands for none.
            xp: the library of arrays: `numpy` on the host, or `jax.numpy`.
        """
        if self.place is None:
            own = xp.arange(self.count * stages, dtype=np.int32).reshape(self.bodies, stages, TWIST)
            return xp.concatenate([own, xp.full((1, stages, TWIST), absent, np.int32)])
        place = xp.concatenate([xp.asarray(self.place), xp.full((1, TWIST), self.count, np.int32)])[:, None]
        here = place * stages + xp.arange(stages, dtype=np.int32)[:, None]
        return xp.where(place == self.count, absent, here)

    def nodes(self) -> Int[np.ndarray, " count"]:
        """Body of each rate; on the host."""
        if self.component is None:
            return np.repeat(np.arange(self.bodies), TWIST)
        return np.asarray(self.component) // TWIST

    def twists(self, w: Float[Array, " n"], rows: Float[Array, "bodies 4 3"]) -> Float[Array, "bodies s 6"]:
        """Twists of all nodes at the stages from their rates.

        Args:
            w: rates at all stages.
            rows: of the nodes at the start of the step.
        """
        stages = w.shape[0] // max(self.count, 1)
        if self.place is None:
            return w.reshape(self.bodies, stages, TWIST)
        by_rate = jnp.concatenate([w.reshape(-1, stages), jnp.zeros((1, stages), w.dtype)])
        found = jnp.swapaxes(by_rate[self.place], 1, 2)
        if self.directed is None:
            return found
        own = found[self.directed, :, 3:]
        spin = jnp.einsum("bsi,bix->bsx", own, rows[self.directed, 1:])
        return found.at[self.directed, :, 3:].set(spin)

    def balances(
        self, wrenches: Float[Array, "bodies s 6"], rows: Float[Array, "bodies 4 3"]
    ) -> Float[Array, " n"]:
        """What wrenches on all nodes do along their rates, at the stages; the transpose of `twists`."""
        if self.directed is not None:
            torque = wrenches[self.directed, :, 3:]
            own = jnp.einsum("bsx,bix->bsi", torque, rows[self.directed, 1:])
            wrenches = wrenches.at[self.directed, :, 3:].set(own)
        return self.picked(wrenches)

    def picked(self, components: Float[Array, "bodies s 6"]) -> Float[Array, " n"]:
        """Those of all components of twists that are rates."""
        if self.component is None:
            return components.reshape(-1)
        by_component = jnp.swapaxes(components, 1, 2).reshape(self.bodies * TWIST, -1)
        return by_component[self.component].reshape(-1)

    def parts(self, w: Float[Array, " count"]) -> tuple[Float[Array, " count"], Float[Array, " count"]]:
        """What of some rates moves points, and what turns triads and directors."""
        component = np.arange(self.count) if self.component is None else self.component
        moving = component % TWIST < 3
        return jnp.where(moving, w, 0.0), jnp.where(moving, 0.0, w)

    def by_stage(self, w: Float[Array, " n"], stages: int) -> Float[Array, "s count"]:
        """Rates of all stages, one stage after the other."""
        if self.component is not None:
            return w.reshape(-1, stages).T
        return jnp.moveaxis(w.reshape(self.bodies, stages, TWIST), 1, 0).reshape(stages, -1)

    def repeated(self, w: Float[Array, " count"], stages: int) -> Float[Array, " n"]:
        """The same rates at all stages."""
        if self.component is not None:
            return jnp.repeat(w, stages)
        shape = self.bodies, stages, TWIST
        return jnp.broadcast_to(w.reshape(self.bodies, 1, TWIST), shape).reshape(-1)

    def blocks(
        self, bodies: Int[Array | np.ndarray, "n k"], start: Float[Array, "bodies_and_ground 4 3"]
    ) -> Callable[[Array, int], Array]:
        """How derivatives by twists become derivatives by rates: what is there of the spin, along its axes.

        Args:
            bodies: of the instances.
            start: rows at the start of the step.

        Returns:
            A function of the derivatives (n, *rest) and of their axis for the instances' bodies, that is
            followed by those for stages and components of the twist.
        """
        if self.directed is None:
            return lambda derivatives, axis: derivatives
        fixed = jnp.broadcast_to(jnp.eye(3, dtype=start.dtype), start[:, 1:].shape)
        own = fixed.at[self.directed].set(start[self.directed, 1:])[jnp.asarray(bodies)]

        def along(derivatives: Array, axis: int) -> Array:
            moved = jnp.moveaxis(derivatives, (axis, axis + 1, axis + 2), (1, -2, -1))
            shape = (*own.shape[:2], *(1,) * (moved.ndim - 4), 3, 3)
            spin = jnp.einsum("...sx,...ix->...si", moved[..., 3:], own.reshape(shape))
            moved = jnp.concatenate([moved[..., :3], spin], axis=-1)
            return jnp.moveaxis(moved, (1, -2, -1), (axis, axis + 1, axis + 2))

        return along
