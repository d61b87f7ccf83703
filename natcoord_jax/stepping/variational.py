"""The momentum-symplectic scheme: the mid-point rule as a discrete variational principle."""

from dataclasses import dataclass, replace

from natcoord_jax.maths.collocation import Tableau, gauss
from natcoord_jax.stepping.scheme import Scheme


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
