"""A tennis player who hits a ball: driven rigid bodies, a racket of beams and strings, a ball of a shell."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import natcoord_jax as nc
from natcoord_jax.bodies.mesh_handle import MeshHandle
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import Result
from natcoord_jax.gallery.example import Example
from natcoord_jax.gallery.player import Player, add_player, placements, twist_of
from natcoord_jax.gallery.racket import (
    RADIUS,
    SEMI_AXES,
    THICKNESS,
    Part,
    Racket,
    add_ball,
    add_racket,
    inflated_ball,
    with_part,
)
from natcoord_jax.gallery.segments import IMPACT, TIMES, X, Z
from natcoord_jax.stepping.room import cut

GRIP, THROAT = (0.0, -0.84, 1.42), (0.0, -1.12, 1.42)
"""Of the racket on the player who stands upright [m]."""

CLEARANCE = 0.02
"""Between ball and strings where the scene is assembled [m]."""

GRAVITY = 9.81
HAND = "right hand"

HIT = float(TIMES[IMPACT])
"""Time of the impact [s]."""

END = float(TIMES[-1])
"""Until which it runs [s]."""

STEP = 0.01
"""Of the swing [s]."""

ROOM = 256
"""Steps that one program has room for, so that it serves strokes of other lengths, too."""

SUBSTEPS = 2000
"""Beyond one a step: while the racket swings to and fro after the impact, steps of the swing are too long."""

SPANS = ((HIT - 0.005, None), (HIT + 0.012, 1e-4), (HIT + 0.05, 5e-4), (END, 1e-3))
"""Ends of the phases [s] and their steps [s]; None: that of the run. A contact lasts 5 ms and the ball rings
for some 30 ms."""

SNAPSHOTS = (0.0, 1.1, 1.8, 1.95, 2.002, 2.03, 2.3, 2.6)
"""Times of the snapshots [s]."""

COURT = (-1.3, -1.4, -0.05), (1.7, 1.1, 1.9)
"""Corners of the box that pictures look into [m]: the ball comes from 30 m away."""


class Stroke(NamedTuple):
    """What an impact was like.

    Attributes:
        dwell: how long ball and strings touch [s].
        force: the largest between them [N].
        before: velocity of the ball at first [m/s].
        after: the same at the end [m/s].
        racket: velocity of the middle of the strings that the swing alone gives at the impact [m/s].
    """

    dwell: float
    force: float
    before: Float[np.ndarray, "3"]
    after: Float[np.ndarray, "3"]
    racket: Float[np.ndarray, "3"]


def stroke(phases: nc.Phases, ball: Any, hit: float = HIT) -> Stroke:
    """What the impact of a run was like."""
    force, t = force_on_ball(phases), np.asarray(phases.t)
    touching = force[:-1] > 0
    flight = flight_of(phases, ball)
    speed, spin = twist_of(HAND, hit)
    racket = speed + np.cross(spin, placements(hit)[HAND](_middle()))
    return Stroke(float(np.diff(t)[touching].sum()), float(force.max()), flight[0], flight[-1], racket)


def force_on_ball(phases: nc.Phases) -> Float[np.ndarray, " t"]:
    """Of the strings [N]."""
    parts = [np.asarray(system.sense(run, "impact").force).sum(axis=1) for system, run in phases.pairs]
    return np.concatenate(parts)


def flight_of(phases: nc.Phases, ball: Any) -> Float[np.ndarray, "t 3"]:
    """Velocity of the centre of mass of the ball [m/s]."""
    system = phases.systems[0]
    numbers = np.array([system.body_index(node) for node in ball.nodes])
    mass = np.asarray(system.mass)[numbers, 0, 0]
    v = np.concatenate([np.asarray(run.states.v)[:, 4 * numbers] for run in phases.trajectories])
    return np.einsum("k,tkx->tx", mass / mass.sum(), v)


def _middle() -> np.ndarray:
    """Of the head of the racket on the player who stands upright [m]."""
    return np.add(THROAT, SEMI_AXES[0] * np.array([0.0, -1.0, 0.0]))


def _flight(speed: float, start: float) -> tuple[np.ndarray, np.ndarray]:
    """Where a ball is at a time, and its velocity, which flies into the middle of the strings."""
    there, ahead = placements(HIT)[HAND], HIT - start
    place = there(_middle()) + (RADIUS + THICKNESS) * (there.rotation @ X)
    # Back along the parabola of a ball that then flies level.
    velocity = np.array([-speed, 0.0, GRAVITY * ahead])
    return place - velocity * ahead + np.array([0.0, 0.0, 0.5 * GRAVITY * ahead**2]), velocity


def _racket_at_rest(placed: Any, start: float) -> Part:
    """The racket alone, in equilibrium with the tension of its strings, moving as the hand does."""
    scene = nc.Scene()
    add_racket(scene, nc.ground, placed, GRIP, THROAT, Z)
    system, state = scene.compile()
    state = nc.equilibrium(system, state, steps=1).state
    q = np.asarray(state.q)
    speed, spin = twist_of(HAND, start)
    v = np.cross(spin, q)
    v[::4] += speed
    return system, replace_fields(state, v=as_array(v))


def _phases(
    system: nc.System, state: nc.State, steps: int, dt: float, *, start: float, **options: Any
) -> nc.Phases:
    """The run in phases, of which that of the impact has small steps; it ends where one fails."""
    plan, begin, last = [], start, start + steps * dt
    for end, step in SPANS:
        end = min(end, last)
        count = round((end - begin) / (step or dt))
        if count > 0:
            plan.append((count, (end - begin) / count))
            begin = end
    most, found, now = max(ROOM, *(count for count, _ in plan)), [], state
    options = {"extra_substeps": SUBSTEPS} | options
    for count, step in plan:
        run = nc.simulate(system, now, dt=step, steps=nc.Steps(count, most), **options)
        found.append(cut(run, count))
        if not Result(int(run.result)).ok:
            break
        now = jax.tree.map(lambda x: x[-1], found[-1].states)
    return nc.Phases((system,) * len(found), tuple(found))


def figure(racket: Racket, ball: Any, phases: nc.Phases) -> Any:
    """Figures 9 to 11 of the paper: snapshots, and the strain energy of what is flexible; force and speed."""
    from natcoord_jax.viz import Curve, Panel, plot_snapshots

    t, parts = np.asarray(phases.t), strain_energies(phases)
    total = Curve("all", t, np.sum(list(parts.values()), axis=0))
    near = (t > HIT - 0.005) & (t < HIT + 0.02)
    ms, since = 1e3 * (t[near] - HIT), f"t - {HIT:g} s [ms]"
    close = [Curve(name, ms, values[near]) for name, values in parts.items()]
    speed = np.linalg.norm(flight_of(phases, ball), axis=1)
    drives = np.sum([np.asarray(w) for name, w in phases.work().items() if "drive" in name], axis=0)
    books = [np.asarray(nc.balance(system, run).energy) for system, run in phases.pairs]
    panels = [
        Panel("strain energy of racket and ball", "[J]", [total]),
        Panel("of each at the impact", "[J]", close, abscissa=since),
        Panel("force of the strings on the ball", "[N]", [Curve("force", ms, force_on_ball(phases)[near])],
              abscissa=since),
        Panel("speed of the ball", "[m/s]", [Curve("speed", ms, speed[near])], abscissa=since),
        Panel("work of the drives", "[J]", [Curve("work", t, drives)]),
        Panel("balance of energy, with that work", "[-]", [Curve("balance", t, np.concatenate(books))],
              logarithmic=True),
    ]  # fmt: skip
    return plot_snapshots(phases, SNAPSHOTS, panels, beams=racket.beams, within=COURT)


def strain_energies(phases: nc.Phases) -> dict[str, Float[np.ndarray, " t"]]:
    """Of frame, strings and ball, from what they are at first [J]."""
    stores = {name: np.asarray(x) for name, x in phases.energy().stores.items()}
    rest = "gravity 1", "impact", "ball", "gas", "net"
    parts = {
        "frame": np.sum([x for name, x in stores.items() if name not in rest], axis=0),
        "strings": stores["net"],
        "ball": stores["ball"] + stores["gas"],
    }
    return {name: values - values[0] for name, values in parts.items()}


@dataclass(frozen=True)
class Assembled:
    """Player, racket and ball before the impact.

    Attributes:
        system: compiled system.
        state: at the start.
        ball: its handle.
        racket: its handles.
        player: its handles.
    """

    system: nc.System
    state: nc.State
    ball: MeshHandle
    racket: Racket
    player: Player


def assembled(count: int, speed: float, start: float) -> Assembled:
    """Player, racket and ball; for the arguments see `tennis`."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    player = add_player(scene, start)
    here, there = player.placed[HAND], placements(HIT)[HAND]
    racket = add_racket(scene, player.bodies[HAND], here, GRIP, THROAT, Z)
    # Assembled in front of the strings, turned as it will hit them, so that its nodes know their facets.
    before = here(_middle()) + (RADIUS + THICKNESS + CLEARANCE) * (here.rotation @ X)
    ball = add_ball(scene, count, position=before, orientation=here.rotation @ there.rotation.T)
    given = {"stiffness": 1e5, "candidates": 9, "one_pass": True}
    scene.add(nc.Contact(ball.surface("outside"), racket.bed, name="impact", **given))
    # Velocities are those of the drives and, of what is flexible, as set below.
    system, state = scene.compile(assemble=True, t=start)
    place, velocity = _flight(speed, start)
    for part in (_racket_at_rest(here, start), inflated_ball(count, place, velocity)):
        state = with_part(state, system, part)
    return Assembled(system, state, ball, racket, player)


def tennis(count: int = 3, speed: float = 15.0, start: float = 0.0, end: float = END) -> Example:
    """A tennis player of 19 rigid bodies hits a ball with a racket of beams and strings (8.3 of the paper).

    The motion of the player is driven through a forehand; the impact is at two seconds. The run is in
    phases, of which that of the impact has small steps. Started later, the racket moves as a rigid body.

    Args:
        count: of cells of the ball along each edge of the cube that its mesh is made of.
        speed: of the ball that comes [m/s].
        start: time at which the run begins [s].
        end: and ends [s].
    """
    made = assembled(count, speed, start)
    system, state, ball, racket = made.system, made.state, made.ball, made.racket
    facts = {"ball": ball, "racket": racket, "player": made.player, "impact": HIT}
    return Example(
        "tennis",
        "a tennis player",
        system,
        state,
        STEP,
        round((end - start) / STEP),
        facts=facts,
        phases=partial(_phases, system, state, start=start),
        figure=partial(figure, racket, ball),
        beams=racket.beams,
        within=COURT,
    )
