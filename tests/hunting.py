"""Random scenes and the losses that are differentiated: by the library, and by a plain reference.

A `Template` is a structure; a seed gives the numbers. All cases of one template share their programs. Of
the engine the hunt needs what `hunting_protocol` lists: records of rollouts slot by slot, tangent velocities.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import plain
from hunting_effects import STEPS, Chance
from hunting_protocol import Plan, coordinate_rates, plan_of, record

import natcoord_jax as nc

KINDS = "start", "system", "inputs", "step"
"""What changes along the directions of a case."""


@dataclass(frozen=True)
class Template:
    """A structure and how it is run.

    Attributes:
        name: of it.
        build: function of a generator to (systems, state, other state, inputs, dt): one system and array of
            inputs (or policy) for each phase, the first state, and one that moves otherwise.
        scheme: that makes the steps.
        save_every: states that the loss sees.
        extra: substeps for retries.
        rtol: of error control.
        until: event.
        more: modes besides forward and reverse.
        exhaustive: whether its programs take too long to compile for the slow suite.
    """

    name: str
    build: Callable
    scheme: Any = nc.EnergyMomentum()
    save_every: int = 1
    extra: int = 16
    rtol: float | None = None
    until: Callable | None = None
    steps: int = STEPS
    more: tuple[str, ...] = ()
    exhaustive: bool = False

    @property
    def options(self) -> dict:
        """Of `nc.simulate`."""
        made = dict(scheme=self.scheme, save_every=self.save_every, until=self.until, rtol=self.rtol)
        return made | dict(extra_substeps=self.extra, throw=False)


class Case(eqx.Module):
    """Numbers of a template: those that are differentiated, all others, and what is asked."""

    numbers: Any
    static: Any
    weights: Any
    directions: Any


# --- one case ---------------------------------------------------------------------------------------------


def case_of(template: Template, seed: int) -> Case:
    """Random numbers, weights of the loss and directions."""
    rng = Chance(seed)
    systems, state, other, inputs, dt = template.build(rng)
    state, other = template.scheme.started(state), template.scheme.started(other)
    parts = [eqx.partition(system, eqx.is_inexact_array) for system in systems]
    numbers = dict(
        systems=tuple(part for part, _ in parts), state=state, inputs=tuple(inputs), dt=jnp.asarray(dt)
    )
    numbers = jax.tree.map(lambda x: jnp.asarray(x, float), numbers)
    weights = [_weights(rng, system, template) for system in systems]
    nothing = jax.tree.map(jnp.zeros_like, numbers)
    directions = [
        nothing | dict(state=_moved(rng, systems[0], state, other)),
        nothing | dict(systems=tuple(_changed(rng, part) for part, _ in parts)),
        nothing | dict(inputs=jax.tree.map(partial(_noise, rng, 0.3), numbers["inputs"])),
        nothing | dict(dt=0.1 * numbers["dt"]),
    ]
    directions = jax.tree.map(lambda *x: jnp.stack(x), *directions)
    return Case(numbers, tuple(static for _, static in parts), tuple(weights), directions)


def _noise(rng: Chance, size: float, x: Any) -> Any:
    scale = max(float(np.max(np.abs(x), initial=0.0)), 1e-3)
    return jnp.asarray(size * scale * rng.normal(size=np.shape(x)))


def _weights(rng: Chance, system: nc.System, template: Template) -> tuple:
    saved = template.steps // template.save_every
    structure = system.structure
    size = 24 * len(structure.bodies) + len(structure.coordinates) + structure.rotors + len(structure.works)
    times = 0.3 * rng.normal(size=saved)
    times[-1] = 1.0
    return tuple(jnp.asarray(x) for x in (times, *rng.normal(size=(2, size)) / np.sqrt(size)))


def _moved(rng: Chance, system: nc.System, state: nc.State, other: nc.State) -> nc.State:
    """A change of the state that all constraints admit: further on along the motion, and another motion."""
    along, across = 0.1 * rng.normal(), 0.3 * rng.normal()
    still = jax.tree.map(jnp.zeros_like, state)
    rates = coordinate_rates(system, state)
    return eqx.tree_at(
        lambda s: (s.t, s.q, s.coordinates, s.v, s.rates),
        still,
        (
            jnp.asarray(along),
            along * state.v,
            along * rates,
            across * (other.v - state.v),
            across * (other.rates - state.rates),
        ),
    )


def _changed(rng: Chance, system: nc.System) -> nc.System:
    """Relative changes of masses and of all numbers of effects; geometry of joints stays."""

    def relative(x: Any) -> Any:
        factors = 0.1 * rng.normal(size=np.shape(x))
        return jnp.asarray(np.where(np.isfinite(x), factors * np.where(np.isfinite(x), x, 0.0), 0.0))

    still = jax.tree.map(jnp.zeros_like, system)
    effects = [jax.tree.map(relative, group.effect) for group in system.effects]
    masses = system.mass * jnp.asarray(0.1 * rng.normal(size=(system.mass.shape[0], 1, 1)))
    made = eqx.tree_at(lambda s: s.mass, still, masses)
    return eqx.tree_at(lambda s: [g.effect for g in s.effects], made, effects)


# --- the loss ---------------------------------------------------------------------------------------------


def flat_states(states: nc.State) -> jax.Array:
    """Numbers of stacked states, time and numerical losses left out."""
    parts = states.q, states.v, states.coordinates, states.rates, states.work
    return jnp.concatenate([x.reshape(x.shape[0], -1) for x in parts], axis=1)


def score(x: jax.Array, weights: tuple) -> jax.Array:
    times, linear, bent = weights
    return times @ (x @ linear + 0.1 * (x @ bent) ** 2)


def loss(rollout: Callable, numbers: Any, static: Any, weights: Any) -> Any:
    """A smooth function of all saved states of all phases, and what the rollouts say besides."""
    state, before, total, said = numbers["state"], None, 0.0, []
    for k, (part, fixed) in enumerate(zip(numbers["systems"], static)):
        system = eqx.combine(part, fixed)
        if before is not None:
            system, state = nc.transfer(before, state, system)
        saved, more = rollout(k, system, state, numbers["inputs"][k], numbers["dt"])
        state, before = jax.tree.map(lambda x: x[-1], saved), system
        total = total + score(flat_states(saved), weights[k])
        said.append(more)
    return total, said


def simulated(template: Template, checkpoint: bool = False) -> Callable:
    """The loss by the library."""

    def rollout(k: int, system: nc.System, state: nc.State, inputs: Any, dt: Any) -> tuple:
        options = template.options | dict(checkpoint=checkpoint, steps=template.steps)
        made = nc.simulate(system, state, dt=dt, inputs=inputs, **options)
        return jax.tree.map(lambda x: x[1:], made.states), (made.result, made.steps_rejected)

    return lambda *arguments: loss(rollout, *arguments)


def _plan(template: Template, inputs: Any) -> Plan:
    return plan_of(template.scheme, template.steps, template.extra, template.until, callable(inputs))


def _saved(template: Template, slots: Any, states: nc.State) -> nc.State:
    wanted = jnp.arange(template.save_every, template.steps + 1, template.save_every)
    ends = jnp.minimum(jnp.searchsorted(slots.finished, wanted), slots.finished.shape[0] - 1)
    return jax.tree.map(lambda x: x[ends], states)


def recorded(template: Template) -> Callable:
    """The loss by the library, with the records of all slots."""

    def rollout(k: int, system: nc.System, state: nc.State, inputs: Any, dt: Any) -> tuple:
        slots, code = record(_plan(template, inputs), system, state, inputs, dt, template.rtol)
        return _saved(template, slots, slots.states), (slots, code)

    return lambda *arguments: loss(rollout, *arguments)


def plainly(template: Template, records: Any, corrections: int = 2) -> Callable:
    """The loss by the plain reference, along the same slots."""

    def rollout(k: int, system: nc.System, state: nc.State, inputs: Any, dt: Any) -> tuple:
        slots = records[k][0]
        numbers = system, state, inputs, dt
        after, apart = plain.states(_plan(template, inputs), slots, numbers, corrections=corrections)
        saved = _saved(template, slots, after)
        return saved, (flat_states(saved), apart)

    return lambda *arguments: loss(rollout, *arguments)
