"""From one system to another in the middle of a motion: joints that close, and joints that open."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import STATE, State
from natcoord_jax.mechanics.admissible_velocities import with_admissible_velocities
from natcoord_jax.mechanics.coordinates import state_rates
from natcoord_jax.mechanics.violations import residuals
from natcoord_jax.model.model import SYSTEM, Model, SomeModel
from natcoord_jax.model.rows import rows_with_ground
from natcoord_jax.reading.matching import (
    check_bodies,
    check_joints,
    common_joints,
    held,
    in_layout,
    new_joints,
    rotor_names,
    taking_hold,
    with_coordinates_of,
)

GAP = 1e-9
"""Largest gap [m, -] of a joint that has closed, per unit of size."""


@checked(system=SYSTEM, state=STATE, into=SYSTEM, onto=STATE)
def transfer(
    system: Model, state: State, into: SomeModel, *, onto: State | None = None
) -> tuple[SomeModel, State]:
    """A state of one system as a state of another: joints may close and open in the middle of a motion.

    Both systems are compiled from scenes with the same bodies. What has the same name is the same: bodies
    keep their positions and velocities, joints of both their frames and coordinates, work accounts go on.

    A joint that only `into` has closes: it takes its two bodies as they are. The child has the frame that its
    scene gave it, the parent gets the same one at this pose, and coordinates count from here (44-47). An
    impact follows: of all velocities that the joints of `into` admit, the new ones are nearest to the old
    ones in the metric of the mass (rotors included), which is what impulsive reactions bring about. So
    momentum and angular momentum change by impulses of the ground only, and kinetic energy is lost, that of
    the difference: `system.energy(before).kinetic - into.energy(after).kinetic`. Bodies that meet at rest
    lose none. A joint that only `system` has opens, without any impulse.

    Args:
        system: of the state.
        state: one state.
        into: system to go on with.
        onto: state of `into`, for the bodies that `system` lacks, their joints, coordinates and accounts:
            so a part that has been treated by itself (an equilibrium, say) comes into the whole.

    Returns:
        `into` with the frames of its joints where they close, and its state, at the same time. Pure,
        jittable, differentiable; accounts and coordinates that `into` lacks are left behind.

    Raises:
        ValueError: for bodies that one of the systems lacks, a joint that joins other bodies than before, or
            one that cannot close where its bodies are (a distance has no length there).

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> def cars(coupled):
        ...     scene = nc.Scene()
        ...     first = scene.add(nc.RigidBody(mass=2.0, inertia=(1, 1, 1), velocity=(3, 0, 0), name="first"))
        ...     car = nc.RigidBody(mass=1.0, inertia=(1, 1, 1), position=(5, 0, 0), name="second")
        ...     second = scene.add(car)
        ...     if coupled:
        ...         scene.add(nc.Fixed(first, second, name="coupling"))
        ...     return scene.compile(assemble=coupled)
        >>> system, state = cars(False)
        >>> trajectory = nc.simulate(system, state, dt=0.1, steps=15)
        >>> meeting = jax.tree.map(lambda x: x[-1], trajectory.states)
        >>> train, state = nc.transfer(system, meeting, cars(True)[0])
        >>> state.v[::4, 0].round(12).tolist()
        [2.0, 2.0]
        >>> float((state.q[4, 0] - state.q[0, 0]).round(12))
        0.5
    """
    check_bodies(system, into, onto)
    check_joints(system, into)
    made, moved = _transferred(system, state, into, onto)
    names = {into.structure.joints[int(j)] for j in new_joints(system, into)}
    if names and is_concrete(made, moved):
        _check_closed(made, moved, names)
    return made, moved


@briefly
def _transferred(system: Model, state: State, into: SomeModel, onto: State | None) -> tuple[SomeModel, State]:
    before, after = common_joints(system, into)
    into = replace_fields(into, frames=into.frames.at[after].set(system.frames[before]))
    moved = in_layout(system, state, into, onto)
    joints = new_joints(system, into)
    if not joints.size:
        return into, moved
    closes = taking_hold(system, into, joints)
    into = held(into, rows_with_ground(moved.q), joints, closes)
    moved = with_coordinates_of(into, moved, joints, closes)
    return into, _after_impact(system, into, moved, jnp.any(closes))


def _after_impact(system: Model, into: Model, moved: State, closes: Bool[Array, ""]) -> State:
    """The state with velocities that the joints admit, if any closes."""
    found = with_admissible_velocities(into, moved, _rates_before(system, into, moved))[0]
    return jax.tree.map(lambda x, y: jnp.where(closes, x, y), found, moved)


def _rates_before(system: Model, into: Model, moved: State) -> Float[Array, " coordinates"]:
    """Rates of the coordinates before the impact, those that the rotors of both have had included."""
    known, rates = set(rotor_names(system)), state_rates(into, moved)
    for group in into.effects:
        if group.effect.rotors:
            stored = np.array([name in known for name in group.names])
            rates = rates.at[group.coordinates[stored, 0]].set(moved.rates[group.rotors[stored, 0]])
    return rates


def _check_closed(system: Model, state: State, names: set[str]) -> None:
    size = 1.0 + float(np.max(np.abs(np.asarray(state.q))))
    for group, (value, _) in zip(system.joints, residuals(system, state)):
        gaps = np.max(np.abs(np.asarray(value)), axis=1, initial=0.0)
        for name, gap in zip(group.names, gaps):
            if name in names and not gap <= GAP * size:
                raise ValueError(
                    f"joint {name!r} cannot close where its bodies are: its constraints are violated by "
                    f"{gap:.3g} m; bring the bodies to where it holds, or join them by another joint"
                )
