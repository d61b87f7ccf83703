"""Forces: loads on markers from stage quantities and inputs; fields: forces on the mass of every body."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.kinds import NAME
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.potential import MarkerEffect, marker_response, place_markers


class Load(eqx.Module):
    """What a force puts on its markers.

    Attributes:
        forces: on the marker vectors: [N] on points, [N m] on directions; None: there are none.
        torques: on the bodies of the markers [N m]; None: there are none.
    """

    forces: Float[Array, "k *m 3"] | None
    torques: Float[Array, "k 3"] | None


class Force(MarkerEffect):
    """Base of forces that are no potentials: subclass it and give `load`.

    Attributes:
        markers: points and directions, in the order `load` receives them.
        name: optional name; it names the entry of the work account, and the input channels.

    Class attributes:
        inputs: number of input channels that one instance adds to the system.

    Example:
        >>> import natcoord_jax as nc
        >>> class Drag(nc.Force):
        ...     coefficient: float = 0.1
        ...     def load(self, x, rate, inputs, t):
        ...         return nc.Load(-self.coefficient * rate, None)
    """

    kind: ClassVar[str] = "force"
    works: ClassVar[bool] = True

    @abc.abstractmethod
    def load(
        self,
        x: Float[Array, "k *m 3"],
        rate: Float[Array, "k *m 3"],
        inputs: Float[Array, " inputs"],
        t: Float[Array, ""],
    ) -> Load:
        """Load on the markers.

        Args:
            x: marker vectors at the stage (the mid-point for one stage).
            rate: their velocities.
            inputs: the effect's own input channels.
            t: time of the stage [s].
        """

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """The load at every stage."""
        x, rates = place_markers(place, motion.rows), place_markers(place, motion.rates)
        load = jax.vmap(self.load)(x, rates, now.stage_inputs, now.times)
        if load.forces is not None and load.forces.shape != x.shape:
            raise ValueError(
                f"{type(self).__name__}.load: forces have shape {load.forces.shape[1:]}; give one for each "
                f"marker vector, {x.shape[1:]}, or None"
            )
        return marker_response(place, load.forces, load.torques, rates, motion)


class Field(Effect):
    """Base of conservative fields on the mass of every body, linear in position.

    A field sits on all bodies at once: its place is the mass block m (4, 4) of the body, with
    force rows m_a0 g (14, 19).
    """

    name: Any = eqx.field(default=None, kw_only=True, metadata=is_a(NAME))

    kind: ClassVar[str] = "field"
    stores: ClassVar[bool] = True
    shared: ClassVar[bool] = True

    @abc.abstractmethod
    def acceleration(self) -> Float[Array, "3"]:
        """Uniform acceleration [m/s^2]."""

    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Array) -> Response:
        """Force rows m_a0 g, exact for every method because the potential is linear."""
        forces = place[:, 0, None] * self.acceleration()
        stages = now.tableau.stages
        forces = jnp.broadcast_to(forces, (stages, 1, *NODE))
        power = jnp.sum(forces * motion.rates, axis=(1, 2, 3))
        return Response(forces, None, jnp.zeros((stages, 0)), power)

    def stored(self, place: Array, rows: Array, coordinates: Array, rates: Array) -> Array:
        """Potential energy [J], zero where all rows with mass are at the origin."""
        return -jnp.sum(place[:, 0, None] * self.acceleration() * rows[0])
