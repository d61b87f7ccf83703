"""The contract of an effect, looked at along random motions: for effects of one's own."""

from functools import cached_property
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.build import build
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.coordinate import CoordinateEffect
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.joint import frames_at
from natcoord_jax.core.kinds import FLAG, JOINT_NAME, HandleOf, of
from natcoord_jax.core.numeric import Whole
from natcoord_jax.core.potential import place_markers
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.mechanics.reduced import ReducedStep
from natcoord_jax.mechanics.response import gather, respond, situation
from natcoord_jax.model.groups import Group
from natcoord_jax.model.own_effects import inside as acting_inside
from natcoord_jax.model.own_effects import rigid_changes, third_differences
from natcoord_jax.model.rows import group_places, rows_with_ground
from natcoord_jax.scene import Scene
from natcoord_jax.stepping.step import advance
from natcoord_jax.system import System

TABLEAU = gauss(1)
STEPS = 10.0 ** -np.arange(1.0, 9.5, 0.5)
"""Of central differences, falling."""
ROUNDING = 1e-9
"""Errors up to which what should be exact is: some thousand roundings of the largest terms."""
DIFFERENCE = 1e-7
"""The same of the best of the differences, of which it is the power 2/3."""


class Contract:
    """How far an effect keeps its contract: errors relative to the terms they are of, or 0.

    What is asked for is computed then, and kept.

    Attributes:
        name: of the effect.
        seeds: number of random motions.
    """

    def __init__(self, system: System, state: State, group: Group, name: str, seeds: int) -> None:
        self.system, self.state, self.group, self.name, self.seeds = system, state, group, name, seeds
        self._u, self._h = 0.5 + jnp.arange(len(system.structure.inputs)), jnp.ones(())
        self._step = ReducedStep.prepare(system, state, self._u, self._h, TABLEAU)
        self._where = situation(system, group, state, self._u, self._h)
        kind = group.effect
        alone = kind.shared or group.source == "mass"
        self._one: Any = kind if alone else jax.tree.map(lambda x: x[0], kind)
        # (Of contacts with friction the forces are unknowns: what they do is judged along motions.)
        self.stores = kind.stores and not kind.unilateral

    @property
    def _inside(self) -> bool:
        """Whether all of its instances act between bodies."""
        return len(acting_inside(self.system, self.group)) == self.group.count

    def broken(self, inside: bool | None = None) -> list[str]:
        """What is not kept, with the remedy."""
        inside = self._inside if inside is None else inside
        moving, rest = (float(np.min(x)) for x in self.differences)
        said = [
            (self.degree, ROUNDING, "is not at most quadratic: make lengths squares, angles products"),
            (self.invariance, ROUNDING, "is another when everything is turned and moved together"),
            (self.power, ROUNDING, "books another power than its forces have: take both from one law"),
            (self.push * inside, ROUNDING, "pushes the whole: forces on its markers have to cancel"),
            (self.turn * inside, ROUNDING, "turns the whole: let it depend on relative positions alone"),
            (self.balance, ROUNDING, "stores another energy than its forces take: give `energy` alone"),
            (self.free, ROUNDING, "has free motions that its residual forbids: declare `free = False`"),
            (moving, DIFFERENCE, "has derivatives that are none of its values"),
            (rest, DIFFERENCE, "has derivatives that are none, at rest"),
            (self.reverse, ROUNDING, "has reverse derivatives other than forward ones: use jax.custom_jvp"),
        ]
        return [f"{words} (by {error:.2g})" for error, allowed, words in said if not error <= allowed]

    # --- what it answers to motions ---

    def _motion(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Rates of about one radian and one metre in the step, and random multipliers."""
        rng = np.random.default_rng(seed)
        w = rng.normal(size=self.system.structure.unknowns)
        return w * 1.2 / np.linalg.norm(w[:6]), rng.normal(size=self.group.multipliers)

    def _answer(self, w: Array, lam: Array) -> tuple[Any, Any]:
        """Answer to rates of the free motions and multipliers, and the motion."""
        motion = gather(self.group, self._step.stations(self._step.motion(w[None])[0]))
        each = jnp.broadcast_to(lam, (self.group.count, 1, self.group.multipliers))
        return respond(self.group, self._where, motion, each, TABLEAU), motion

    def _energies(self, w: Array) -> Array:
        """Stored before and after."""
        system, state, step = self.system, self.state, self._step
        if not self.stores:
            return jnp.zeros(2)
        if isinstance(self.group.effect, CoordinateEffect):  # its coordinates are summed up over the steps
            y = jnp.zeros(system.structure.unknowns + system.structure.multipliers).at[: len(w)].set(w)
            after = advance(system, state, self._u, self._h, y, TABLEAU)[1]
        else:
            rates = step.stations(step.motion(w[None])[0]).rates[0, :-1].reshape(-1, 3)
            after = replace_fields(state, q=state.q + rates)
        name = self.group.labels[0]
        return jnp.stack([system.energy(s).stores[name] for s in (state, after)])

    @cached_property
    def _starts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where differences are taken, a motion and rest, a direction, and multipliers."""
        moving, lam = self._motion(3)
        direction = np.random.default_rng(4).normal(size=moving.shape)
        return moving, np.zeros_like(moving), direction, lam

    @cached_property
    def _answers(self) -> tuple[Any, list[np.ndarray]]:
        """One program for all motions: of the seeds, of the differences, and rest."""
        moving, rest, direction, lam = self._starts
        lanes = [self._motion(seed) for seed in range(self.seeds)]
        for w in (moving, rest):
            lanes += [(w + sign * step * direction, lam) for sign in (1.0, -1.0) for step in STEPS]
        lanes.append((rest, lam))

        @jax.jit
        @jax.vmap
        def looked(w: Array, lam: Array) -> Any:
            return *self._answer(w, lam), self._energies(w)

        found = jax.tree.map(np.asarray, looked(*(np.stack(x) for x in zip(*lanes, strict=True))))
        return found, [lam for _, lam in lanes]

    def _of_lane(self, lane: int) -> tuple[float, ...]:
        """Size of what acts, and errors of power, resultants and energy."""
        found, multipliers = self._answers
        response, motion, (before, after) = jax.tree.map(lambda x: x[lane], found)
        rows, rates, kind = motion.rows[0], motion.rates[0], self.group.effect
        forces = np.zeros_like(rows) if response.forces is None else response.forces.reshape(rows.shape)
        torques = np.zeros_like(motion.spin[0]) if response.torques is None else response.torques[:, 0]
        size = float(np.sum(np.abs(forces)) + np.sum(np.abs(torques)))
        scale = size if size > 0 else 1.0
        work = np.sum(forces * rates) + np.sum(torques * motion.spin[0])
        # (What a rotor takes is not lost: it is stored.)
        booked = np.sum(
            response.power if kind.works or kind.stores else multipliers[lane] * response.rows[:, 0]
        )
        power = 0.0 if kind.rotors else abs(work - booked) / scale
        push = np.max(np.abs(forces[:, :, 0].sum((0, 1)))) / scale
        turn = np.max(np.abs(np.cross(rows, forces).sum((0, 1, 2)) + torques.sum((0, 1))))
        turn = turn / (scale * (1 + np.max(np.abs(rows))))
        balance = abs(after - before + work) / (1 + abs(after) + abs(before)) if self.stores else 0.0
        return size, float(power), float(push), float(turn), float(balance), float(abs(after - before))

    def _worst(self, figure: int) -> float:
        return max(self._of_lane(lane)[figure] for lane in range(self.seeds))

    def _resultant(self, figure: int) -> float:
        """As assembled of constraints that motions violate: forces at both ends of a gap make a couple."""
        if self.group.multipliers and not self.group.in_tree:
            return self._of_lane(-1)[figure]
        return self._worst(figure)

    @property
    def size(self) -> float:
        """Sum of its forces and torques, the least of the motions [N, N m]."""
        return min(self._of_lane(lane)[0] for lane in range(self.seeds))

    @property
    def power(self) -> float:
        """Force times velocity less the power that it books, or than the rates of its constraints take."""
        return self._worst(1)

    @property
    def push(self) -> float:
        """Resultant force on all bodies."""
        return self._resultant(2)

    @property
    def turn(self) -> float:
        """Resultant torque on all bodies, about the origin."""
        return self._resultant(3)

    @property
    def balance(self) -> float:
        """Change of the stored energy and work on the bodies, over a step of a radian."""
        return self._worst(4)

    @property
    def exchanged(self) -> float:
        """Change of the stored energy, the least of the motions [J]."""
        return min(self._of_lane(lane)[5] for lane in range(self.seeds))

    # --- derivatives ---

    def _values(self, w: Array) -> Array:
        """All that depends on a motion."""
        response, motion = self._answer(w, jnp.asarray(self._starts[3]))
        parts = [response.forces, response.torques, response.rows, motion.rates]
        return jnp.concatenate([x.reshape(-1) for x in parts if x is not None])

    @cached_property
    def differences(self) -> Float[np.ndarray, "2 steps"]:
        """Errors of central differences of what is answered, for all `STEPS`: in motion, and at rest."""
        response, motion = self._answers[0][:2]
        parts = [response.forces, response.torques, response.rows, motion.rates]
        values = np.concatenate([x.reshape(len(x), -1) for x in parts if x is not None], axis=1)
        moving, rest, direction, _ = self._starts
        ahead_at = jax.jit(lambda w: jax.jvp(self._values, (w,), (jnp.asarray(direction),)))
        found = []
        for number, w in enumerate((moving, rest)):
            ahead, first = np.asarray(ahead_at(w)[1]), self.seeds + 2 * len(STEPS) * number
            plus, minus = np.split(values[first : first + 2 * len(STEPS)], 2)
            errors = np.max(np.abs((plus - minus) / (2.0 * STEPS[:, None]) - ahead), axis=1)
            found.append(errors / np.max(np.abs(ahead)))
        return np.array(found)

    @cached_property
    def reverse(self) -> float:
        """Reverse derivatives less forward ones."""
        moving, rest, direction, _ = self._starts

        @jax.jit
        def products(w: Array) -> tuple[Array, Array]:
            ahead = jax.jvp(self._values, (w,), (jnp.asarray(direction),))[1]
            weights = jnp.cos(ahead)
            return jax.vjp(self._values, w)[1](weights)[0] @ direction, weights @ ahead

        pairs = [products(jnp.asarray(w)) for w in (moving, rest)]
        return max(float(abs(back - ahead) / abs(ahead)) for back, ahead in pairs)

    # --- what it is made of ---

    @cached_property
    def degree(self) -> float:
        """Third differences of what has to be quadratic: a residual, or invariants."""
        if type(self.group.effect).quadratic is Effect.quadratic:
            return 0.0
        return max(
            third_differences(self.system, self.group, self.state, seed)[0] for seed in range(self.seeds)
        )

    @cached_property
    def invariance(self) -> float:
        """Change of energies or residuals when everything is pushed, or turned, together."""
        return float(np.max(rigid_changes(self.system, self.group, self.state)[0], initial=0.0))

    @cached_property
    def free(self) -> float:
        """Of a joint of the tree: rates of its constraints along free motions, and what these leave."""
        if not self.group.in_tree:
            return 0.0
        place = self.system.frames[self.group.joints[0, 0]]
        effect = self._one

        @jax.jit
        def looked(state: State, w: Array) -> tuple[Array, Array, State]:
            step = ReducedStep.prepare(self.system, state, self._u, self._h, TABLEAU)
            motion = gather(self.group, step.stations(step.motion(w[None])[0]))
            rows, rates = motion.rows[0, 0], motion.rates[0, 0]

            def residual(rows: Array) -> Array:
                return effect.residual(*frames_at(place, rows))

            moved = step.stations(step.motion(w[None])[0]).rates[0, :-1].reshape(-1, 3)
            rate = jax.jvp(residual, (rows,), (rates,))[1]
            return rate, residual(rows + 0.5 * rates), replace_fields(state, q=state.q + moved)

        rng, state, worst = np.random.default_rng(7), self.state, 0.0
        for _ in range(5):
            w = rng.normal(size=self.system.structure.unknowns)
            w[3:6] *= 0.2  # drift of the first body
            w /= np.linalg.norm(w[:3])
            rate, after, state = looked(state, jnp.asarray(w))
            errors = np.max(np.abs(np.concatenate([rate, after])), initial=0.0)
            worst = max(worst, float(errors / (1.0 + np.max(np.abs(w))) ** 2))
        return worst

    @cached_property
    def cancels(self) -> tuple[float, float]:
        """What is said to be rounded, in terms of stiffness times invariants, and in what reach."""
        if not self.group.effect.elastic:
            return 1.0, 1.0
        one: Any = jax.tree.map(lambda x: x[0], self.group.effect)
        place, rows = (
            group_places(self.system, self.group)[0],
            rows_with_ground(self.state.q)[self.group.bodies[0]],
        )
        coordinate = self.state.coordinates[self.group.coordinates[0]] + 0.3

        @jax.jit
        def numbers(rows: Array, coordinate: Array) -> tuple[Array, ...]:
            scales = one.cancelling(place, rows, coordinate)
            if scales is None:
                return jnp.zeros(()), jnp.zeros(()), jnp.ones(())
            by_coordinate = isinstance(one, CoordinateEffect)
            invariants = coordinate if by_coordinate else one.invariants(place_markers(place, rows))
            stiffness = jnp.diag(one.curvature(place, rows, coordinate))
            return *scales, jnp.sum(jnp.abs(stiffness) * invariants**2)

        energy, reach, whole = (float(x) for x in numbers(rows, coordinate))
        return 1.0 if whole == 0 else energy / whole, reach


EFFECT = JOINT_NAME | HandleOf("effect")


@checked("testing.check_effect")
def check_effect(
    scene: Annotated[Scene, of("a scene", Scene)],
    effect: Annotated[Handle | str, EFFECT],
    *,
    inside: Annotated[bool | None, FLAG] = None,
    seeds: Annotated[int, Whole(1)] = 3,
    throw: Annotated[bool, FLAG] = True,
) -> Contract:
    """Look whether an effect keeps its contract, along random motions of about one radian.

    What it answers has to be consistent with itself: degree, invariance, power and forces, energy and work,
    derivatives and differences. `scene.compile` looks at the degree alone.

    Args:
        scene: with the effect and the bodies that it acts on, few of them.
        effect: handle or name of an effect or a joint.
        inside: whether it acts between bodies, so that it may neither push nor turn them as a whole; None:
            where it stores energy or is a constraint, on several bodies and none of them the ground.
        seeds: number of motions.
        throw: raise where the contract is not kept; else what is asked of the result is looked at then.

    Returns:
        The errors, see `Contract`.

    Raises:
        AssertionError: naming the effect, what it does not keep, by how much, and what to do.
        ValueError: for a name that is no effect of the scene.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> bodies = [scene.add(nc.PointMass(mass=1.0, position=(x, 0, 0))) for x in (0, 1)]
        >>> ends = tuple(nc.Point(body) for body in bodies)
        >>> spring = scene.add(nc.Spring(ends, stiffness=5.0, length=0.3))
        >>> nc.testing.check_effect(scene, spring).push < 1e-12
        True
    """
    name = effect.name if isinstance(effect, Handle) else effect
    parts = scene.bodies, scene.joints, scene.effects, None, scene.nodes, scene.elements
    system, state = build(*parts, list(scene.clamps.values()))
    groups = (*system.effects, *system.joints)
    group = next((g for g in groups if name in g.labels), None)
    if group is None:
        names = [name for g in groups for name in g.labels]
        raise ValueError(f"check_effect: the scene has no effect {name!r}; pass one of {names}")
    contract = Contract(system, state, group, name, seeds)
    broken = contract.broken(inside) if throw else []
    if broken:
        raise AssertionError(f"{type(group.effect).__name__} {name!r} " + "; it ".join(broken))
    return contract
