"""Effects that change suddenly, in time or with the motion, and what random scenes are made of."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from hunting_protocol import admitted

import natcoord_jax as nc

STEPS = 40
"""Of most scenes."""


class Brake(nc.JointDamper):
    """A damper that is put on at a time."""

    at: Any = eqx.field(kw_only=True)

    def force(self, rate, inputs, t):
        return -self.damping * jnp.where(t > self.at, rate, 0.0)


class Dry(nc.JointDamper):
    """Dry friction, smooth over a width of the rate."""

    width: Any = eqx.field(kw_only=True)

    def force(self, rate, inputs, t):
        return -self.damping * jnp.tanh(rate / self.width)


class Valve(nc.JointDamper):
    """A damper that is `ratio` times as strong beyond a rate."""

    beyond: Any = eqx.field(kw_only=True)
    ratio: Any = eqx.field(kw_only=True)

    def force(self, rate, inputs, t):
        return -self.damping * (rate + self.ratio * jnp.maximum(rate - self.beyond, 0.0))


class TwoStage(nc.JointSpring):
    """A spring that is `ratio` times as stiff beyond a coordinate."""

    beyond: Any = eqx.field(kw_only=True)
    ratio: Any = eqx.field(kw_only=True)

    def energy(self, coordinate):
        more = jnp.maximum(coordinate - self.beyond, 0.0)
        return 0.5 * self.stiffness * ((coordinate - self.rest) ** 2 + self.ratio * more**2)


class Latch(nc.Force):
    """A spring of no length between two points, caught at a time and let go at another."""

    stiffness: Any = eqx.field(kw_only=True)
    caught: Any = eqx.field(kw_only=True)
    free: Any = eqx.field(kw_only=True)

    def load(self, x, rate, inputs, t):
        force = jnp.where((t > self.caught) & (t < self.free), self.stiffness, 0.0) * (x[1] - x[0])
        return nc.Load(jnp.stack([force, -force]), None)


class Slack(eqx.Module):
    """Energy of a cable that pulls only where it is longer than a length."""

    stiffness: Any
    length: Any

    def __call__(self, r):
        return 0.5 * self.stiffness * jnp.maximum(r - self.length, 0.0) ** 2


class Blow(eqx.Module):
    """A force that acts for a while."""

    force: Any
    begin: Any
    end: Any

    def __call__(self, t):
        return jnp.where((t > self.begin) & (t < self.end), 1.0, 0.0) * self.force


class Ramp(eqx.Module):
    """A prescribed coordinate that rests, then moves: with a jump in its rate, or its acceleration."""

    begin: Any
    rate: Any
    acceleration: Any

    def __call__(self, t):
        s = jnp.maximum(t - self.begin, 0.0)
        return self.rate * s + 0.5 * self.acceleration * s**2


class Switching(eqx.Module):
    """A policy: torques of one of two sizes, by where the first coordinate is, and some feedback of it."""

    low: Any
    high: Any
    at: Any
    gain: Any

    def __call__(self, t, state):
        coordinate = state.coordinates[0]
        return jnp.where(coordinate > self.at, self.high, self.low) - self.gain * coordinate


# --- numbers ----------------------------------------------------------------------------------------------


class Chance(np.random.Generator):
    """A generator with what scenes ask for."""

    def __init__(self, seed: int):
        super().__init__(np.random.PCG64(seed))

    def size(self, low: float, high: float) -> float:
        """A number of any order of magnitude between two."""
        return float(np.exp(self.uniform(np.log(low), np.log(high))))

    def direction(self) -> np.ndarray:
        """A unit vector."""
        x = self.normal(size=3)
        return x / np.linalg.norm(x)

    def step(self, longest: float = 0.03) -> float:
        """Length of a step [s]."""
        return self.size(1e-3, longest)

    def time(self, dt: float, steps: int = STEPS) -> float:
        """A time [s] well within the run."""
        return dt * steps * self.uniform(0.15, 0.75)

    def jumps(self, count: int, size: float, shape: tuple = (STEPS,)) -> np.ndarray:
        """Inputs that are constant between a few steps."""
        ends = np.sort(self.integers(1, shape[0], size=3))
        level = np.searchsorted(ends, np.arange(shape[0]), side="right")
        levels = size * self.normal(size=(4, *shape[1:], count))
        return levels[level]

    def body(self, place: Any, name: str, reach: float = 0.3, light: float = 1.0, **more: Any) -> Any:
        """A body, with its centre of mass at some distance from its place."""
        mass = light * self.uniform(0.5, 3.0)
        inertia, com = 0.05 * mass * self.uniform(0.8, 1.2, 3), reach * self.uniform(-1.0, 1.0, 3)
        return nc.RigidBody(mass=mass, inertia=inertia, com=com, position=place, name=name, **more)

    def gravity(self) -> Any:
        """In any direction."""
        return nc.Gravity(vector=self.size(1.0, 20.0) * self.direction())

    def stops(self, joint: Any, stiffest: float = 1e8, room: float = 0.3, **more: Any) -> Any:
        """Stops on either side."""
        lower, upper = -self.size(0.02, room), self.size(0.02, room)
        stiffness = self.size(1e2, stiffest)
        return nc.JointStops(joint, lower=lower, upper=upper, stiffness=stiffness, **more)

    def dry(self, joint: Any, **more: Any) -> Any:
        """Dry friction."""
        return Dry(joint, damping=self.size(1e-2, 10.0), width=self.size(1e-4, 1e-1), **more)

    def brake(self, joint: Any, dt: float, **more: Any) -> Any:
        """A brake put on within the run."""
        return Brake(joint, damping=self.size(1e-1, 1e4), at=self.time(dt), **more)

    def valve(self, joint: Any, **more: Any) -> Any:
        """A damper that switches with the rate."""
        how = dict(beyond=self.normal(), ratio=self.size(1.0, 1e3))
        return Valve(joint, damping=self.size(1e-2, 1.0), **how, **more)

    def two_stage(self, joint: Any, **more: Any) -> Any:
        """A spring that switches with the coordinate."""
        how = dict(rest=0.3 * self.normal(), beyond=0.3 * self.normal(), ratio=self.size(1.0, 1e4))
        return TwoStage(joint, stiffness=self.size(1.0, 1e2), **how, **more)


# --- starts -----------------------------------------------------------------------------------------------


def pushed(rng: Chance, system: nc.System, state: nc.State, speed: float = 2.0) -> Any:
    """Of any system: as it is, and two motions that its constraints admit."""
    return [admitted(system, state, jnp.asarray(speed * rng.normal(size=state.v.shape))) for _ in range(2)]


def started(rng: Chance, system: nc.System, state: nc.State, angle: float = 0.5, speed: float = 2.0) -> Any:
    """Of an open tree: random coordinates, and two motions from there."""
    key = jax.random.key(int(rng.integers(2**31)))
    return pushed(rng, system, nc.random_state(system, state, key, coordinates=angle), speed)
