"""A tennis player who hits a ball: driven rigid bodies, a racket of beams and strings, a ball of a shell."""

from typing import Any

import jax
import numpy as np

import natcoord_jax as nc
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.gallery.example import Example
from natcoord_jax.gallery.player import TIMES, X, Z, add_player, placements
from natcoord_jax.gallery.racket import RADIUS, SEMI_AXES, THICKNESS, add_ball, add_racket

GRIP, THROAT = (0.0, -0.84, 1.42), (0.0, -1.12, 1.42)
"""Of the racket on the player who stands upright [m]."""

CLEARANCE = 0.02
"""Between ball and strings where the scene is assembled [m]."""

GRAVITY = 9.81
HAND = "right hand"


def _flight(speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Where a ball is at the start, and its velocity, which flies into the middle of the strings."""
    hit = float(TIMES[3])
    there = placements(hit)[HAND]
    middle = np.add(THROAT, SEMI_AXES[0] * np.array([0.0, -1.0, 0.0]))
    place = there(middle) + (RADIUS + THICKNESS) * (there.rotation @ X)
    # Back along the parabola of a ball that then flies level.
    velocity = np.array([-speed, 0.0, GRAVITY * hit])
    return place - velocity * hit + np.array([0.0, 0.0, 0.5 * GRAVITY * hit**2]), velocity


def _racket_at_rest(placed: Any) -> tuple[nc.System, nc.State]:
    """The racket alone, in equilibrium with the tension of its strings, held where the hand is."""
    scene = nc.Scene()
    add_racket(scene, nc.ground, placed, GRIP, THROAT, Z)
    system, state = scene.compile()
    return system, replace_fields(nc.equilibrium(system, state, steps=1).state, t=state.t)


def _inflated(count: int, place: Any, velocity: Any) -> tuple[nc.System, nc.State]:
    """The ball alone, in equilibrium with its gas, flying."""
    scene = nc.Scene()
    add_ball(scene, count, velocity=velocity)
    system, state = scene.compile()
    # At the origin, where places are rounded least.
    q = np.array(nc.equilibrium(system, state, steps=1).state.q)
    q[::4] += place
    return system, replace_fields(state, q=as_array(q))


def _with(system: nc.System, state: nc.State, part: nc.System, rest: nc.State) -> tuple[nc.System, nc.State]:
    """A system at a state in which the bodies of a part are as they are there, by name."""
    q, v = np.array(state.q), np.array(state.v)
    for k, name in enumerate(part.structure.bodies):
        rows = slice(4 * system.body_index(name), 4 * system.body_index(name) + 4)
        q[rows], v[rows] = rest.q[4 * k : 4 * k + 4], rest.v[4 * k : 4 * k + 4]
    return system, replace_fields(state, q=as_array(q), v=as_array(v))


def tennis(count: int = 3, speed: float = 15.0) -> Example:
    """A tennis player of 19 rigid bodies hits a ball with a racket of beams and strings (8.3 of the paper).

    The motion of the player is driven through a forehand; the impact is at two seconds. The run is in three
    phases, of which that of the impact has small steps.

    Args:
        count: of cells of the ball along each edge of the cube that its mesh is made of.
        speed: of the ball that comes [m/s].
    """
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    player = add_player(scene)
    racket = add_racket(scene, player.bodies[HAND], player.placed[HAND], GRIP, THROAT, Z)
    place, velocity = _flight(speed)
    # Assembled in front of the strings, turned as it will hit them, so that its nodes know their facets.
    there, here = placements(float(TIMES[3]))[HAND], player.placed[HAND]
    middle = np.add(THROAT, SEMI_AXES[0] * np.array([0.0, -1.0, 0.0]))
    turned = here.rotation @ there.rotation.T
    before = here(middle) + (RADIUS + THICKNESS + CLEARANCE) * (here.rotation @ X)
    ball = add_ball(scene, count, position=before, orientation=turned, velocity=velocity)
    given = {"stiffness": 1e5, "candidates": 9, "one_pass": True}
    scene.add(nc.Contact(ball.surface("outside"), racket.bed, name="impact", **given))
    system, state = scene.compile()
    for part, rest in (_racket_at_rest(player.placed[HAND]), _inflated(count, place, velocity)):
        system, state = _with(system, state, part, rest)

    def phases(steps: int, dt: float, **options: Any) -> nc.Phases:
        hit = float(TIMES[3])
        spans = (0.0, hit - 0.01, dt), (hit - 0.01, hit + 0.02, 1e-4), (hit + 0.02, steps * dt, dt)
        found, now = [], state
        for begin, end, h in spans:
            count = max(1, round((end - begin) / h))
            found.append(nc.simulate(system, now, dt=(end - begin) / count, steps=count, **options))
            now = jax.tree.map(lambda x: x[-1], found[-1].states)
        return nc.Phases((system,) * len(found), tuple(found))

    facts = {"ball": ball, "racket": racket, "player": player, "impact": float(TIMES[3])}
    return Example(
        "tennis", "a tennis player", system, state, 5e-3, 600, facts=facts, phases=phases, beams=racket.beams
    )
