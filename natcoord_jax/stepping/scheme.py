"""What a scheme is, and the energy-momentum family."""

import abc
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import checked, require
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import FLAG, Choice, of
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau, gauss

LARGEST = 10
"""Largest order of the energy-momentum family."""
ORDER = Choice(tuple(range(2, LARGEST + 1, 2)))


class Scheme(abc.ABC):
    """Base of the schemes that `simulate` and `step` can use: hashable, without arrays."""

    @property
    @abc.abstractmethod
    def tableau(self) -> Tableau:
        """Coefficients of the method."""

    @property
    def stages(self) -> int:
        """Number of stages s."""
        return self.tableau.stages

    @property
    def order(self) -> int:
        """Order of accuracy of positions."""
        return self.tableau.order

    @property
    def loose(self) -> bool:
        """Whether velocities of states have parts normal to the constraints, which readings leave out."""
        return not self.tableau.tangent

    @checked("times", dt=Number(), steps=Whole(1), start=Number())
    def times(
        self, dt: Float[Array, ""] | float, steps: int, start: float = 0.0
    ) -> Float[Array, "steps stages"]:
        """Times of the stages [s], where `simulate` takes inputs of shape (steps, stages, inputs).

        Args:
            dt: step [s].
            steps: number of steps.
            start: start time [s].
        """
        return start + dt * (jnp.arange(steps)[:, None] + jnp.asarray(self.tableau.c))

    def started(self, state: State) -> State:
        """The state with all that the scheme keeps account of."""
        located, counts = self.tableau.max_events > 0, state.contacts
        if counts is not None and counts.shape[-1] != 3 + located:
            counts = jnp.pad(counts, ((0, 0), (0, 1))) if located else counts[..., :3]
        state = replace_fields(state, contacts=counts, elapsed=jnp.zeros_like(state.t) if located else None)
        if not self.tableau.dissipative or state.dissipated is not None:
            return state
        return replace_fields(state, dissipated=jnp.zeros_like(state.t))


@dataclass(frozen=True)
class EnergyMomentum(Scheme):
    """The energy-momentum family: Gauss collocation in the null space of the constraints.

    Order two is the one-stage step (57) of the paper. With s stages the order is 2 s, in positions and,
    thanks to kicks along the normals of the constraints, in velocities; energy, momenta and constraints of
    positions and of velocities hold to round-off at every order. Without kicks energy, momenta and
    constraints of positions still do, but velocities obey their constraints only as accurately as the
    scheme is, and lose orders: what is normal to the constraints changes its sign in every step.

    Kicks take several times as long as the rest of a step of order two, which therefore has none. Its states
    keep velocities as (57) makes them; what is read of them (rates, velocities, accelerations, reactions,
    and the states that controllers and terminal events are given) are the nearest velocities that the
    constraints admit, see `System.tangent`.

    Impacts of contacts without a stiffness are located where that is asked for: the step at hand is split at
    the time at which a gap closes, where the impact law acts, and goes on from there. That time is an unknown
    of derivatives, too, which are those of the motion then.

    Attributes:
        order: 2, 4, 6, 8 or 10.
        kick: whether velocities are kept tangent by kicks. None: from order four on; at order two they are
            read so. False: they are neither, order two is (57) as it stands.
        max_events: impacts that a step is split at, at most; 0: none are located. What is left of a step
            after so many, or that meets more slowly than by 1e-8 of the size of the places in a step, is made
            by the impact law of whole steps. So what bounces ever faster comes to rest.

    Raises:
        ValueError: for another order, and impacts to locate at an order above two.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), angular_velocity=(0, 1, 0.1)))
        >>> system, state = scene.compile()
        >>> trajectory = nc.simulate(system, state, dt=0.1, steps=10, scheme=nc.EnergyMomentum(order=6))
    """

    order: int = 2
    kick: bool | None = field(default=None, kw_only=True)
    max_events: int = field(default=0, kw_only=True)

    def __post_init__(self) -> None:
        wrong = ORDER.complaint(self.order)
        if wrong is not None:
            raise ValueError(f"EnergyMomentum: order {wrong}; pass an even number from 2 to {LARGEST}")
        require(self, "kick", FLAG | of("None", type(None)))
        require(self, "max_events", Whole(0))
        if self.max_events and self.order > 2:
            raise ValueError(
                f"EnergyMomentum: max_events is {self.max_events} at order {self.order}; impacts are located "
                "at order 2: leave out `order` or `max_events`"
            )

    @property
    def tableau(self) -> Tableau:
        """Coefficients of the method."""
        kick = self.order > 2 if self.kick is None else bool(self.kick)
        tableau = gauss(int(self.order) // 2, kick)
        return replace(tableau, max_events=int(self.max_events)) if self.max_events else tableau

    @property
    def loose(self) -> bool:
        """Whether velocities of states have parts normal to the constraints, which readings leave out."""
        return self.kick is None and not self.tableau.kick


SECOND_ORDER = EnergyMomentum()
"""The step of the paper (57)."""

SCHEME = of("nc.EnergyMomentum(...), nc.VariationalMidpoint() or nc.Dissipative(...)", Scheme)
"""What an argument may be."""
