"""What a scheme is: the energy-momentum family, the dissipative scheme and the variational mid-point rule."""

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


@dataclass(frozen=True)
class Dissipative(Scheme):
    """Energy-decaying, momentum-conserving step of order two, for stiff scenes with fast oscillations.

    The one-stage energy-momentum step (57) with internal forces that damp what the step is too long to
    resolve, and nothing else. At any step and any stiffness

        E_{n+1} = E_n + work of loads, inputs and drives - dissipated,    dissipated >= 0,

    exactly, with momentum and angular momentum conserved and constraints at round-off; rigid motions and
    steady deformation are not damped. A linear oscillation of frequency omega is multiplied by -rho in a step
    as omega h grows beyond all bounds; with the default, by 0.84 at omega h = 10, by 0.998 at six steps a
    period and by 1 - 3e-7 at sixty. The damping is of third order in omega h, the scheme of order two; with
    rho = 1 it is (57). Velocities obey their constraints as accurately as the scheme is, as those of (57) do.
    The equations are in `natcoord_jax.mechanics.dissipation`.

    What is dissipated is in `State.dissipated` [J] and, as "numerical dissipation", in `System.work`.

    Damped are oscillations of springs through the curvature of their energy in its invariants at the start
    of the step: the squared length for springs between points, the coordinate for springs on joints. What is
    stiff by tension alone has none: a spring between points of no natural length, or a taut string across its
    line, is not damped but conserves energy; give it a length, or use a spring on a joint. The same holds
    where an energy is not convex in its invariants, and for effects with a `respond` of their own.

    Whatever solver a system was compiled for, the step is solved densely in the joint null space: large trees
    run, but slowly.

    The aim is that of Armero & Romero 2001, CMAME 190, 2603 and 6783 (energy decay with momenta conserved and
    high frequencies under control); the construction is another one, of one stage.

    Attributes:
        spectral_radius: rho in [0, 1], what is left of an infinitely fast oscillation after a step.

    Raises:
        ValueError: for another spectral radius.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), angular_velocity=(0, 0, 1)))
        >>> hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 0, 1)))
        >>> spring = scene.add(nc.JointSpring(hinge, stiffness=1e8))
        >>> system, state = scene.compile()
        >>> damped = nc.Dissipative(spectral_radius=0.5)
        >>> trajectory = nc.simulate(system, state, dt=0.1, steps=10, scheme=damped)
        >>> bool(system.energy(trajectory).total[-1] < 1e-5)
        True
    """

    spectral_radius: float = 0.8

    def __post_init__(self) -> None:
        wrong = Number().complaint(self.spectral_radius)
        if wrong is not None or not 0.0 <= self.spectral_radius <= 1.0:
            said = wrong or f"is {self.spectral_radius!r}"
            raise ValueError(f"Dissipative: spectral_radius {said}; pass a number from 0 to 1")

    @property
    def tableau(self) -> Tableau:
        """One stage, and what is to be damped."""
        return replace(gauss(1), spectral_radius=float(self.spectral_radius))


@dataclass(frozen=True)
class VariationalMidpoint(Scheme):
    """The variational mid-point rule: symplectic, momenta exact, energy bounded but not exact; order two.

    The discrete Lagrangian of a step from q_0 to q_1, both on the constraints, is

        L_d = 1/(2h) (q_1 - q_0)^T M (q_1 - q_0) - h sum_e V_e( (pi_e(q_0) + pi_e(q_1))/2 ),

    with the energies V_e of the potentials taken at the means of their invariants pi_e (of joint coordinates
    for springs on these), not at the invariants of the mean position: a stiff spring that only turns stays
    unstrained. L_d is as invariant under translations and rotations as the invariants are, so that momentum
    and angular momentum are conserved (Noether). With p_0 = M v_0 and p_1 = M v_1 on the tangent spaces,

        M (q_1 - q_0)/h = p_0 - h/2 D pi(q_0)^T V' + G(q_0)^T lam_0,         g(q_1) = 0,
        p_1 = M (q_1 - q_0)/h - h/2 D pi(q_1)^T V' + G(q_1)^T lam_1,         G(q_1) v_1 = 0,

    solved in the null space of the constraints at either end (the discrete null space method). The map from
    (q_0, p_0) to (q_1, p_1) preserves the canonical form dq ^ M dv on the constraint manifold exactly;
    velocities obey the constraints to round-off. Energy oscillates with the square of the step without a
    trend over times that are exponentially long in 1/h, as long as steps resolve the motion and are equal
    (with `rtol`, or where steps had to be repeated in parts, they are not); where energy has to be exact,
    use `EnergyMomentum`.
    Loads, dampers and inputs are taken at mid-steps and enter both ends by halves (Lagrange-d'Alembert).
    Rotors, drives, loops and redundant constraints are treated alike; an effect with a `respond` of its own
    enters as a load.

    Whatever solver a system was compiled for, the step is solved densely in the joint null space, and the
    velocity at its end by a Cholesky factorisation of the inertia: large trees run, but slowly.

    Sources: Marsden & West 2001, Acta Numerica 10, 1.5 and 3.4 (discrete Lagrangians, constraints);
    Leyendecker, Marsden & Ortiz 2008, ZAMM 88, 677 (discrete null space of multibody systems).

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), angular_velocity=(0, 1, 0.1)))
        >>> system, state = scene.compile()
        >>> trajectory = nc.simulate(system, state, dt=0.1, steps=10, scheme=nc.VariationalMidpoint())
        >>> energy = system.energy(trajectory).total
        >>> bool(abs(energy - energy[0]).max() < 1e-4)
        True
    """

    @property
    def tableau(self) -> Tableau:
        """One stage at the mid-point, forces at both ends."""
        return replace(gauss(1), variational=True)
