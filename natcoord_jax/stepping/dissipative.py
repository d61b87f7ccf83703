"""The dissipative scheme: high frequencies decay, momenta do not."""

from dataclasses import dataclass, replace

from natcoord_jax.core.numeric import Number
from natcoord_jax.maths.collocation import Tableau, gauss
from natcoord_jax.stepping.scheme import Scheme


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
