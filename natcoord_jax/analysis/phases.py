"""A motion in phases: trajectories of several systems with the same bodies, one after the other."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.kinds import Several
from natcoord_jax.core.state import TRAJECTORY, Trajectory
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.reading.diagnostics import Energy
from natcoord_jax.system import System


class Phases(Part):
    """Trajectories that follow one another, each with its system; see `nc.transfer`.

    The last state of a phase and the first one of the next have the same time: what an impact changes is
    there twice, before and after. `nc.plot` and `nc.animate` take phases as they take a trajectory.

    Attributes:
        systems: one for each phase.
        trajectories: one for each phase.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> def scene(held):
        ...     made = nc.Scene()
        ...     made.add(nc.Gravity())
        ...     ball = made.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), name="ball"))
        ...     if held:
        ...         made.add(nc.Revolute(nc.ground, ball, point=(1, 0, 0), axis=(0, 1, 0), name="hinge"))
        ...     return made.compile()
        >>> system, state = scene(held=True)
        >>> swing = nc.simulate(system, state, dt=0.01, steps=20)
        >>> flying, state = nc.transfer(system, jax.tree.map(lambda x: x[-1], swing.states), scene(False)[0])
        >>> flight = nc.simulate(flying, state, dt=0.01, steps=20)
        >>> motion = nc.Phases((system, flying), (swing, flight))
        >>> motion.t.shape, bool(abs(motion.energy().total).max() < 1e-12)
        ((42,), True)
    """

    systems: tuple[System, ...] = eqx.field(metadata=is_a(Several(SYSTEM, 1)))
    trajectories: tuple[Trajectory, ...] = eqx.field(metadata=is_a(Several(TRAJECTORY, 1)))

    def __check_init__(self) -> None:
        """One system for each trajectory.

        Raises:
            ValueError: for no phase, or another number of trajectories than of systems.
        """
        if not self.systems or len(self.systems) != len(self.trajectories):
            raise ValueError(
                f"phases: {len(self.systems)} systems and {len(self.trajectories)} trajectories; pass as "
                "many of one as of the other, at least one"
            )

    @property
    def pairs(self) -> list[tuple[System, Trajectory]]:
        """System and trajectory of each phase."""
        return list(zip(self.systems, self.trajectories))

    @property
    def t(self) -> Float[Array, " saved"]:
        """Saved times [s]."""
        return jnp.concatenate([trajectory.t for trajectory in self.trajectories])

    def energy(self) -> Energy:
        """Kinetic and stored energies [J]; a store that a phase lacks is zero there."""
        every = [system.energy(trajectory) for system, trajectory in self.pairs]
        names = dict.fromkeys(name for energy in every for name in energy.stores)
        stores = {
            n: jnp.concatenate([e.stores.get(n, jnp.zeros_like(e.kinetic)) for e in every]) for n in names
        }
        return Energy(jnp.concatenate([energy.kinetic for energy in every]), stores)

    def work(self) -> dict[str, Float[Array, " saved"]]:
        """Work done so far [J], by name; an account that a phase lacks rests there."""
        every = [(trajectory.t, system.work(trajectory)) for system, trajectory in self.pairs]
        found = {}
        for name in dict.fromkeys(name for _, accounts in every for name in accounts):
            parts, last = [], jnp.zeros(())
            for t, accounts in every:
                parts.append(accounts.get(name, jnp.full_like(t, last)))
                last = parts[-1][-1]
            found[name] = jnp.concatenate(parts)
        return found

    def momentum(self) -> Float[Array, "saved 3"]:
        """Momentum L [kg m/s]."""
        return self._joined(System.momentum)

    def angular_momentum(self) -> Float[Array, "saved 3"]:
        """Angular momentum J about the origin [kg m^2/s] (55)."""
        return self._joined(System.angular_momentum)

    def constraint_error(self) -> Float[Array, " saved"]:
        """Largest violation of the constraints of each phase [m, -]."""
        return self._joined(lambda system, trajectory: system.constraint_errors(trajectory).position)

    def losses(self) -> Float[Array, " changes"]:
        """Energy [J] lost in the impact at each change from one phase to the next."""
        totals = [system.energy(trajectory).total for system, trajectory in self.pairs]
        pairs = zip(totals, totals[1:])
        return jnp.array([before[-1] - after[0] for before, after in pairs])

    def _joined(self, quantity: Callable[[System, Trajectory], Any]) -> Array:
        return jnp.concatenate([quantity(*pair) for pair in self.pairs])
