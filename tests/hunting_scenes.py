"""Random scenes for the hunt: loops, beams, what is gripped, and the table of all of them."""

import hunting_contacts as contacts
import hunting_trees as trees
from hunting import Template
from hunting_effects import Blow, Chance, Latch, pushed
from hunting_trees import none

import natcoord_jax as nc


def parallelogram(rng: Chance):
    """Three bars in a plane loop, whose constraints depend on each other; stops, a brake, a motor."""
    scene, dt = nc.Scene(), rng.step()
    scene.add(rng.gravity())
    height, width, z = rng.uniform(0.3, 0.6), rng.uniform(0.3, 0.9), (0, 0, 1)
    a = scene.add(rng.body((0, 0, 0), "a", 0.2))
    b = scene.add(rng.body((0, height, 0), "b", 0.2))
    c = scene.add(rng.body((width, 0, 0), "c", 0.2))
    crank = scene.add(nc.Revolute(nc.ground, a, point=(0, 0, 0), axis=z, name="crank"))
    scene.add(nc.Revolute(a, b, point=(0, height, 0), axis=z, name="left"))
    scene.add(nc.Revolute(nc.ground, c, point=(width, 0, 0), axis=z, name="rocker"))
    scene.add(nc.Revolute(b, c, point=(width, height + rng.uniform(-0.1, 0.1), 0), axis=z, name="right"))
    scene.add(rng.stops(crank, 1e6))
    scene.add(rng.brake(crank, dt))
    scene.add(nc.JointTorque(crank))
    system, state = scene.compile()
    return (system,), *pushed(rng, system, state), (rng.jumps(1, 5.0),), dt


def ring(rng: Chance):
    """Crank, coupler on two balls, and rocker, out of plane; friction and a latch."""
    scene, dt = nc.Scene(), rng.step()
    scene.add(rng.gravity())
    a = scene.add(rng.body((0, 0, 0), "a", 0.2))
    b = scene.add(rng.body((0.1, 0.4, 0.1), "b", 0.2))
    c = scene.add(rng.body((0.8, 0.1, 0), "c", 0.2))
    crank = scene.add(nc.Revolute(nc.ground, a, point=(0, 0, 0), axis=(0.1, 0.2, 1), name="crank"))
    scene.add(nc.Spherical(a, b, point=(0.1, 0.4, 0.1), name="left"))
    rocker = scene.add(nc.Revolute(nc.ground, c, point=(0.8, 0, 0), axis=(0.3, 0, 1), name="rocker"))
    scene.add(nc.Distance(b, c, point=(0.8, 0.5, 0.2), parent_point=(0.4, 0.5, 0.1), name="rod"))
    scene.add(rng.dry(crank))
    scene.add(rng.stops(rocker, 1e5))
    ends = nc.Point(nc.ground, (0.3, 0.9, 0)), nc.Point(b, (0.4, 0.5, 0.1))
    caught = rng.time(dt)
    scene.add(Latch(ends, stiffness=rng.size(1e1, 1e4), caught=caught, free=caught + 10 * dt))
    system, state = scene.compile()
    return (system,), *pushed(rng, system, state), none(), dt


def _rope(rng: Chance, scene: nc.Scene, **ends):
    section = nc.CircularSection(radius=0.01, E=rng.size(1e6, 1e8), density=1000.0)
    return scene.add(nc.Beam(section, [(0, 0, 0), (0.6, 0, 0)], elements=2, name="rope", **ends))


def rod(rng: Chance):
    """A clamped beam that a force at its tip bends for a while, with damping."""
    scene, dt = nc.Scene(), rng.step(0.01)
    beam = _rope(rng, scene, start=nc.ground, damping=rng.size(1e-4, 1e-2))
    begin = rng.time(dt)
    push = Blow(0.5 * rng.normal(size=3), begin, begin + dt * rng.uniform(0.5, 10.0))
    scene.add(nc.PointForce((nc.Point(beam.end, (0.6, 0, 0)),), force=push))
    system, state = scene.compile()
    return (system,), *pushed(rng, system, state, 0.1), none(), dt


def flag(rng: Chance):
    """A beam on a hinge with stops and a brake."""
    scene, dt = nc.Scene(), rng.step(0.01)
    scene.add(rng.gravity())
    beam = _rope(rng, scene)
    hinge = scene.add(nc.Revolute(nc.ground, beam.start, point=(0, 0, 0), axis=(0, 0, 1)))
    scene.add(rng.stops(hinge, 1e4))
    scene.add(rng.brake(hinge, dt))
    system, state = scene.compile()
    return (system,), *pushed(rng, system, state, 0.3), none(), dt


def grip(rng: Chance):
    """An arm that grips a body, after which both go on together, with friction and stops."""
    masses = rng.integers(2**32)
    stops, dry = rng.integers(2**32), rng.integers(2**32)
    axes = rng.direction(), rng.direction()

    def scene_of(gripped: bool):
        scene, same = nc.Scene(), Chance(masses)
        scene.add(same.gravity())
        arm, load = scene.add(same.body((0, 0, 0), "arm")), scene.add(same.body((0.6, 0, 0), "load", 0.1))
        hinge = scene.add(nc.Revolute(nc.ground, arm, point=(0, 0, 0), axis=axes[0], name="hinge"))
        if gripped:
            scene.add(nc.Revolute(arm, load, point=(0.6, 0, 0), axis=axes[1], name="grip"))
        scene.add(Chance(stops).stops(hinge, 1e6, name="stops"))
        scene.add(Chance(dry).dry(hinge, name="dry"))
        return scene.compile()

    system, state = scene_of(False)
    joined, _ = scene_of(True)
    return (system, joined), *pushed(rng, system, state), none() * 2, rng.step(0.01)


FOURTH, KICKS = nc.EnergyMomentum(order=4), nc.EnergyMomentum(kick=True)
LOCATED = nc.EnergyMomentum(max_events=4)

TEMPLATES = (
    Template("slide", trees.slide),
    Template("disc", trees.disc, more=("checkpointed", "directions")),
    Template("slide, error control", trees.slide, rtol=1e-4, extra=160, exhaustive=True),
    Template("taut, error control", trees.taut, rtol=1e-4, extra=160, exhaustive=True),
    Template("taut, until an event", trees.taut, until=trees.event, exhaustive=True),
    Template("driven", trees.driven, exhaustive=True),
    Template("switching", trees.switching, more=("batch",), exhaustive=True),
    Template("tumbling", trees.tumbling, steps=12, extra=64),
    Template("parallelogram", parallelogram),
    Template("ring", ring, exhaustive=True),
    Template("rod", rod, exhaustive=True),
    Template("slide, fourth order", trees.slide, scheme=FOURTH, save_every=4, exhaustive=True),
    Template("grip", grip, exhaustive=True),
    Template("slide, twice", trees.slide, more=("second",), exhaustive=True),
    Template("slide, damped", trees.slide, scheme=nc.Dissipative(), exhaustive=True),
    Template("disc, twice", trees.disc, more=("second",), exhaustive=True),
    Template("disc, sixth order", trees.disc, scheme=nc.EnergyMomentum(order=6), exhaustive=True),
    Template("disc, variational", trees.disc, scheme=nc.VariationalMidpoint(), exhaustive=True),
    Template("double, fourth order", trees.double, scheme=FOURTH, exhaustive=True),
    Template("arm", trees.arm, save_every=5, exhaustive=True),
    Template("lamp", trees.lamp, exhaustive=True),
    Template("craft", trees.craft, exhaustive=True),
    Template("geared", trees.geared, exhaustive=True),
    Template("mixed", trees.mixed, exhaustive=True),
    Template("tree", trees.tree, exhaustive=True),
    Template("flag", flag, exhaustive=True),
    Template("driven, with kicks", trees.driven, scheme=KICKS, exhaustive=True),
    Template("driven, fourth order", trees.driven, scheme=FOURTH, exhaustive=True),
    Template("driven, sixth order", trees.driven, scheme=nc.EnergyMomentum(order=6), exhaustive=True),
    Template("driven, error control", trees.driven, rtol=1e-4, extra=160, exhaustive=True),
    Template("arm, with kicks", trees.arm, scheme=KICKS, save_every=5, exhaustive=True),
    Template("parallelogram, twice", parallelogram, more=("second",), exhaustive=True),
    Template("shaken", contacts.shaken, exhaustive=True),
    Template("shaken, soft", contacts.soft_shaken, more=("second",), exhaustive=True),
    Template("shaken, located", contacts.shaken, scheme=LOCATED, exhaustive=True),
    Template("bouncing", contacts.bouncing, more=("second",), exhaustive=True),
    Template("bouncing, soft", contacts.soft_bouncing, exhaustive=True),
    Template("bouncing, located", contacts.bouncing, scheme=LOCATED, exhaustive=True),
    Template("sheet", contacts.sheet, exhaustive=True),
    Template("block", contacts.block, more=("second",), exhaustive=True),
    Template("of any size", contacts.sized, more=("second",), exhaustive=True),
)
