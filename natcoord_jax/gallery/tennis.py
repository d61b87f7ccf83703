"""A tennis player who hits a ball: driven rigid bodies, a racket of beams and strings, a ball of a shell."""

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import natcoord_jax as nc
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import Result
from natcoord_jax.gallery.example import Example
from natcoord_jax.gallery.player import TIMES, X, Z, add_player, placements, twist_of
from natcoord_jax.gallery.racket import RADIUS, SEMI_AXES, THICKNESS, Racket, add_ball, add_racket
from natcoord_jax.stepping.room import cut

GRIP, THROAT = (0.0, -0.84, 1.42), (0.0, -1.12, 1.42)
"""Of the racket on the player who stands upright [m]."""

CLEARANCE = 0.02
"""Between ball and strings where the scene is assembled [m]."""

GRAVITY = 9.81
HAND = "right hand"

HIT = float(TIMES[3])
"""Time of the impact [s]."""

END = HIT + 0.1
"""Until which it runs [s]. The swing goes on to three seconds; on the way there the run ends early, while the
ball is far away, for a reason that is not found yet."""

STEP = 0.01
"""Of the swing [s]."""

ROOM = 256
"""Steps that one program has room for, so that it serves strokes of other lengths, too."""

SUBSTEPS = 2000
"""Beyond one a step: while the racket swings to and fro after the impact, steps of the swing are too long."""

SPANS = ((HIT - 0.005, None), (HIT + 0.012, 1e-4), (HIT + 0.05, 5e-4), (END, 1e-3))
"""Ends of the phases [s] and their steps [s]; None: that of the run. A contact lasts 5 ms and the ball rings
for some 30 ms."""

SNAPSHOTS = (0.0, 1.1, 1.8, 1.95, 2.0, 2.006, 2.3, 3.0)
"""Times of the snapshots [s]."""

COURT = (-1.5, -2.0, -0.1), (2.0, 1.5, 2.5)
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
    pushed = [np.asarray(s.sense(run, "impact").force).sum(axis=1) for s, run in phases.pairs]
    force, t = np.concatenate(pushed), np.asarray(phases.t)
    touching = force[:-1] > 0
    system = phases.systems[0]
    numbers = np.array([system.body_index(node) for node in ball.nodes])
    mass = np.asarray(system.mass)[numbers, 0, 0]
    ends = phases.trajectories[0].states.v[0], phases.trajectories[-1].states.v[-1]
    before, after = (mass @ np.asarray(v)[4 * numbers] / mass.sum() for v in ends)
    speed, spin = twist_of(HAND, hit)
    racket = speed + np.cross(spin, placements(hit)[HAND](_middle()))
    return Stroke(float(np.diff(t)[touching].sum()), float(force.max()), before, after, racket)


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


def _racket_at_rest(placed: Any, start: float) -> tuple[nc.System, nc.State]:
    """The racket alone, in equilibrium with the tension of its strings, moving as the hand does."""
    scene = nc.Scene()
    add_racket(scene, nc.ground, placed, GRIP, THROAT, Z)
    system, state = scene.compile()
    q = np.asarray(nc.equilibrium(system, state, steps=1).state.q)
    speed, spin = twist_of(HAND, start)
    v = np.cross(spin, q)
    v[::4] += speed
    return system, replace_fields(state, q=as_array(q), v=as_array(v))


def _inflated(count: int, place: Any, velocity: Any) -> tuple[nc.System, nc.State]:
    """The ball alone, in equilibrium with its gas, flying."""
    scene = nc.Scene()
    add_ball(scene, count, velocity=velocity)
    system, state = scene.compile()
    # At the origin, where places are rounded least.
    q = np.array(nc.equilibrium(system, state, steps=1).state.q)
    q[::4] += place
    return system, replace_fields(state, q=as_array(q))


def _with(state: nc.State, system: nc.System, part: nc.System, rest: nc.State) -> nc.State:
    """A state of a system in which the bodies of a part are as they are there, by name."""
    q, v = np.array(state.q), np.array(state.v)
    for k, name in enumerate(part.structure.bodies):
        rows = slice(4 * system.body_index(name), 4 * system.body_index(name) + 4)
        q[rows], v[rows] = rest.q[4 * k : 4 * k + 4], rest.v[4 * k : 4 * k + 4]
    return replace_fields(state, q=as_array(q), v=as_array(v))


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


def figure(racket: Racket, phases: nc.Phases) -> Any:
    """Figures 10 and 11 of the paper: snapshots, and the strain energy of what is flexible; the force."""
    from natcoord_jax.viz import Curve, Panel, plot_snapshots

    t, stores = np.asarray(phases.t), phases.energy().stores
    rest = ("gravity 1", "impact", "ball", "gas", "net")
    parts = {
        "frame": sum(np.asarray(x) for name, x in stores.items() if name not in rest),
        "strings": np.asarray(stores["net"]),
        "ball": np.asarray(stores["ball"]) + np.asarray(stores["gas"]),
    }
    parts = {name: values - values[0] for name, values in parts.items()}
    total = Curve("all", t, np.sum(list(parts.values()), axis=0))
    near = (t > HIT - 0.005) & (t < HIT + 0.02)
    ms = 1e3 * (t[near] - HIT)
    close = [Curve(name, ms, values[near]) for name, values in parts.items()]
    force = np.concatenate([np.asarray(s.sense(x, "impact").force).sum(axis=1) for s, x in phases.pairs])
    panels = [
        Panel("strain energy of racket and ball", "[J]", [total]),
        Panel("of each at the impact", "[J]", close, abscissa=f"t - {HIT:g} s [ms]"),
        Panel("force of the strings on the ball", "[N]", [Curve("force", ms, force[near])],
              abscissa=f"t - {HIT:g} s [ms]"),
    ]  # fmt: skip
    return plot_snapshots(phases, SNAPSHOTS, panels, beams=racket.beams, within=COURT)


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
    for part, rest in (_racket_at_rest(here, start), _inflated(count, place, velocity)):
        state = _with(state, system, part, rest)
    facts = {"ball": ball, "racket": racket, "player": player, "impact": HIT}
    return Example(
        "tennis",
        "a tennis player",
        system,
        state,
        STEP,
        round((end - start) / STEP),
        facts=facts,
        phases=partial(_phases, system, state, start=start),
        figure=partial(figure, racket),
        beams=racket.beams,
        within=COURT,
    )
