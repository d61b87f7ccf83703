"""What effects see of the motion over a step, and what they answer."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.callables import replace_fields as replace_fields
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.maths.near_spheres import Pairs


class Motion(eqx.Module):
    """Motion of the `k` bodies of one effect (or of `n` equal ones) over a step.

    Attributes:
        start: rows at the start of the step [m for points, - for directors].
        rows: rows at the stages.
        rates: their velocities at the stages [1/s times that].
        spin: angular velocities at the stages [rad/s].
        force_rows: rows on which forces of potentials and constraints take hold; None: those at the stages.
    """

    start: Float[Array, "*n k 4 3"]
    rows: Float[Array, "s *n k 4 3"]
    rates: Float[Array, "s *n k 4 3"]
    spin: Float[Array, "s *n k 3"]
    force_rows: Float[Array, "s *n k 4 3"] | None = None

    @property
    def held(self) -> "Motion":
        """The motion with all rows where forces take hold."""
        if self.force_rows is None:
            return self
        return Motion(self.force_rows[0], self.force_rows, self.rates, self.spin)


class StepContext(eqx.Module):
    """What else an effect (or `n` equal ones) may depend on during a step.

    Attributes:
        t: start time [s].
        h: step [s].
        inputs: the input channels of the effect, held over the step, or given at every stage.
        coordinates: values of the joint coordinates of the effect at the start [rad or m].
        rates: their stored rates (rotors only) [rad/s or m/s].
        tableau: the collocation method.
        stress: what numerical dissipation adds to the gradients of an elastic effect; None: nothing.
        neighbours: what `Effect.neighbours` has found at the start of the step; None: it looks for none.
    """

    t: Float[Array, ""]
    h: Float[Array, ""]
    inputs: Float[Array, "*_ inputs"]  # with or without an axis of stages before the last
    coordinates: Float[Array, "*n c"]
    rates: Float[Array, "*n r"]
    tableau: Tableau = eqx.field(static=True)
    stress: Float[Array, "*n s p"] | None = None
    neighbours: Any = None

    @property
    def times(self) -> Float[Array, " s"]:
        """Times of the stages [s]."""
        return self.t + self.h * jnp.asarray(self.tableau.c)

    @property
    def stage_inputs(self) -> Float[Array, "s inputs"]:
        """Inputs at the stages."""
        return jnp.broadcast_to(self.inputs, (self.tableau.stages, self.inputs.shape[-1]))


class Response(eqx.Module):
    """What an effect (or `n` equal ones) answers for the stages of a step.

    Attributes:
        forces: forces on the rows of its bodies [N for points, N m for directors]; None: there are none.
        torques: torques on its bodies [N m], in the rows the contravariant forces (61); None: there are none.
        rows: rates of its constraints, which the step sets to zero.
        power: power delivered to the bodies [W], for work accounts.
        released: the part of it that comes from what is stored, which is in no account; None: none.
    """

    forces: Float[Array, "*n s k 4 3"] | None
    torques: Float[Array, "*n s k 3"] | None
    rows: Float[Array, "*n s m"]
    power: Float[Array, "*n s"]
    released: Float[Array, "*n s"] | None = None


class NeighbourTangents(eqx.Module):
    """Derivatives of the forces on things by the velocities of others, which are others in every step.

    Each thing is one of the `parts` of the effect, of one body, with `w` components of forces and velocities.

    Attributes:
        pairs: of things that are near each other, for each of `n` instances.
        stiffness: of each pair minus the derivatives of the force on the first by the velocity of the second,
            and of that on the second by the velocity of the first.
        across: velocities of the things by the twists of their bodies.
        along: the same as their increments follow twists, see `core.closed_tangents`.
    """

    pairs: Pairs
    stiffness: Float[Array, "n 2 w w p"]
    across: Float[Array, "n k s r w"]
    along: Float[Array, "n k s r w"]


class SpreadTangents(eqx.Module):
    """Derivatives of the wrenches on many bodies by their twists: sparse ones, and others.

    Attributes:
        parts: of the markers of each part, of all instances one after the other.
        columns: wrenches on all bodies that go with a number that all twists change; None: there is none,
        rows: the derivatives of that number.
        neighbours: what there is besides between markers that are neighbours; None: nothing.
    """

    parts: Float[Array, "nf p s r p s r"]
    columns: Float[Array, "n k s r"] | None = None
    rows: Float[Array, "n k s r"] | None = None
    neighbours: NeighbourTangents | None = None
