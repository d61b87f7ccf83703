"""Random trees for the hunt, of one to eight bodies, with all that changes suddenly.

Every function makes the numbers of one structure: (systems, state, other state, inputs, dt), see `Template`.
"""

import numpy as np
from hunting_effects import STEPS, Blow, Chance, Latch, Ramp, Slack, Switching, pushed, started

import natcoord_jax as nc


def none(steps: int = STEPS) -> tuple:
    """No inputs."""
    return (np.zeros((steps, 0)),)


def slide(rng: Chance):
    """A body between two stops: contacts last a few steps, or less than one."""
    scene = nc.Scene()
    joint = scene.add(nc.Prismatic(nc.ground, scene.add(rng.body((0, 0, 0), "a")), axis=rng.direction()))
    scene.add(rng.stops(joint))
    system, state = scene.compile()
    return (system,), *started(rng, system, state, 0.0), none(), rng.step()


def disc(rng: Chance):
    """A hinge with a brake, dry friction, gravity and a motor."""
    scene, dt = nc.Scene(), rng.step()
    scene.add(rng.gravity())
    joint = scene.add(nc.Revolute(nc.ground, scene.add(rng.body((0, 0, 0), "a")), axis=rng.direction()))
    scene.add(rng.brake(joint, dt))
    scene.add(rng.dry(joint))
    scene.add(nc.JointTorque(joint))
    system, state = scene.compile()
    return (system,), *started(rng, system, state), (rng.jumps(1, 5.0),), dt


def _chain(rng: Chance, count: int):
    scene, links, joints = nc.Scene(), [nc.ground], []
    scene.add(rng.gravity())
    for k in range(count):
        links.append(scene.add(rng.body((0.5 * k, 0, 0), f"link {k}")))
        axis = rng.direction()
        joints.append(
            scene.add(nc.Revolute(*links[-2:], point=(0.5 * k, 0, 0), axis=axis, name=f"hinge {k}"))
        )
    return scene, links[1:], joints


def arm(rng: Chance):
    """Three links: stops, dry friction and a motor at every hinge."""
    scene, _, joints = _chain(rng, 3)
    for k, joint in enumerate(joints):
        scene.add(rng.stops(joint, 1e6, 1.0, name=f"stops {k}"))
        scene.add(rng.dry(joint, name=f"dry {k}"))
        scene.add(nc.JointTorque(joint, name=f"motor {k}"))
    system, state = scene.compile()
    return (system,), *started(rng, system, state), (rng.jumps(3, 5.0),), rng.step()


def double(rng: Chance):
    """Two links with a brake, a valve, a two-stage spring and motors whose torques change within steps."""
    dt = rng.step()
    scene, _, (one, two) = _chain(rng, 2)
    scene.add(rng.brake(one, dt))
    scene.add(rng.valve(two))
    scene.add(rng.two_stage(two))
    for k, joint in enumerate((one, two)):
        scene.add(nc.JointTorque(joint, name=f"motor {k}"))
    system, state = scene.compile()
    return (system,), *started(rng, system, state), (rng.jumps(2, 5.0, (STEPS, 2)),), dt


def taut(rng: Chance):
    """Two links, one with stops, the other on a cable that gets taut."""
    scene, links, joints = _chain(rng, 2)
    scene.add(rng.stops(joints[0], 1e5))
    ends = nc.Point(nc.ground, (0.2, 0.6, 0.0)), nc.Point(links[1], (1.0, 0.0, 0.0))
    scene.add(nc.NonlinearSpring(ends, law=Slack(rng.size(1e2, 1e5), rng.uniform(0.8, 1.2))))
    system, state = scene.compile()
    return (system,), *started(rng, system, state), none(), rng.step()


def event(state: nc.State):
    """The first coordinate passes a place."""
    return state.coordinates[0] - 0.3


def lamp(rng: Chance):
    """Three point masses on cables that get taut, in a wind that comes and goes."""
    scene, last, dt = nc.Scene(), nc.Point(nc.ground), rng.step(0.01)
    scene.add(rng.gravity())
    for k in range(3):
        place = np.array([0.0, 0.0, -0.4 * (k + 1)])
        mass = nc.PointMass(
            mass=rng.uniform(0.5, 2.0), position=place, velocity=rng.normal(size=3), name=f"{k}"
        )
        end = nc.Point(scene.add(mass), place)
        law = Slack(rng.size(1e2, 1e5), rng.uniform(0.3, 0.45))
        scene.add(nc.NonlinearSpring((last, end), law=law, name=f"cable {k}"))
        begin = rng.time(dt)
        wind = Blow(20.0 * rng.normal(size=3), begin, begin + dt * rng.uniform(0.5, 10.0))
        scene.add(nc.PointForce((end,), force=wind, name=f"wind {k}"))
        last = end
    system, state = scene.compile()
    return (system,), *pushed(rng, system, state), none(), dt


def craft(rng: Chance):
    """A free body with a wheel, thruster and torquers that switch; a latch holds it for a while."""
    scene, dt = nc.Scene(), rng.step()
    base = scene.add(rng.body((0, 0, 0), "base"))
    wheel = scene.add(rng.body((0, 0, 0.3), "wheel", 0.1))
    axle = scene.add(nc.Revolute(base, wheel, point=(0, 0, 0.3), axis=rng.direction()))
    scene.add(rng.brake(axle, dt))
    scene.add(nc.BodyForceInput((nc.Point(base, (0.3, 0, 0)), nc.Direction(base, (0, 1, 0)))))
    scene.add(nc.BodyTorqueInput(tuple(nc.Direction(base, x) for x in np.eye(3))))
    ends = nc.Point(nc.ground, (0.5, 0, 0)), nc.Point(base, (0.4, 0, 0))
    caught = rng.time(dt)
    until = caught + dt * rng.uniform(2.0, 20.0)
    scene.add(Latch(ends, stiffness=rng.size(1e1, 1e5), caught=caught, free=until))
    system, state = scene.compile()
    return (system,), *pushed(rng, system, state), (rng.jumps(4, 10.0),), dt


def driven(rng: Chance):
    """A crank whose drive starts to move, with a pendulum that has friction."""
    dt = rng.step()
    scene, _, (one, two) = _chain(rng, 2)
    moving = Ramp(rng.time(dt), 2.0 * rng.normal(), 20.0 * rng.normal())
    scene.add(nc.Drive(one, function=moving))
    scene.add(rng.dry(two))
    scene.add(rng.stops(two, 1e6))
    system, state = scene.compile()
    moved = [system.with_coordinate(state, two, 0.0, rate=2.0 * rng.normal()) for _ in range(2)]
    return (system,), *moved, none(), dt


def geared(rng: Chance):
    """A motor with rotor inertia, its gear, and an arm with stops and friction."""
    scene = nc.Scene()
    scene.add(rng.gravity())
    arm = scene.add(rng.body((0, 0, 0), "arm"))
    rotor = scene.add(rng.body((1, 0, 0), "rotor", 0.0, 0.1))
    joint = scene.add(nc.Revolute(nc.ground, arm, axis=rng.direction(), name="joint"))
    motor = scene.add(nc.Revolute(nc.ground, rotor, axis=rng.direction(), name="motor"))
    scene.add(nc.Coupling((motor, joint), factors=(1.0, -rng.uniform(2.0, 30.0)), coordinate=(0, 0)))
    scene.add(nc.Armature(motor, inertia=rng.size(1e-5, 1e-2)))
    scene.add(nc.JointTorque(motor))
    scene.add(rng.stops(joint))
    scene.add(rng.dry(joint))
    system, state = scene.compile()
    return (system,), *pushed(rng, system, state), (rng.jumps(1, 2.0),), rng.step()


def switching(rng: Chance):
    """A hinge whose torque a policy switches by the angle, with dry friction and a valve."""
    scene = nc.Scene()
    joint = scene.add(nc.Revolute(nc.ground, scene.add(rng.body((0, 0, 0), "a")), axis=rng.direction()))
    scene.add(rng.dry(joint))
    scene.add(rng.valve(joint))
    scene.add(nc.JointTorque(joint))
    system, state = scene.compile()
    policy = Switching(
        *(np.array([5.0 * rng.normal()]) for _ in range(2)), 0.2 * rng.normal(), rng.size(0.1, 10)
    )
    return (system,), *started(rng, system, state), (policy,), rng.step()


def tumbling(rng: Chance):
    """A body on a ball that turns by radians in a step: attempts fail and are repeated in parts."""
    scene = nc.Scene()
    scene.add(rng.gravity())
    spin = rng.size(5.0, 20.0) * rng.direction()
    body = scene.add(rng.body((0, 0, 0), "a", 0.5, angular_velocity=spin))
    scene.add(nc.Spherical(nc.ground, body, point=(0, 0, 0)))
    system, state = scene.compile()
    return (system,), state, pushed(rng, system, state)[0], none(12), rng.uniform(0.2, 0.6)


def mixed(rng: Chance):
    """Four bodies on joints of several kinds, with friction and stops on their coordinates."""
    scene, last = nc.Scene(), nc.ground
    scene.add(rng.gravity())
    kinds = nc.Cylindrical, nc.Universal, nc.Planar, nc.Screw
    for k, kind in enumerate(kinds):
        body = scene.add(rng.body((0.4 * k, 0, 0), f"body {k}"))
        axis = rng.direction()
        second = np.cross(axis, rng.direction())
        more = dict(pitch=rng.uniform(0.1, 0.5)) if kind is nc.Screw else {}
        more |= dict(axis=axis, second=second, name=f"joint {k}")
        joint = kind(last, body, point=(0.4 * k, 0, 0), **more)
        joint, last = scene.add(joint), body
        for c in range(min(2, len(kind.coordinates))):
            scene.add(rng.dry(joint, coordinate=c, name=f"dry {k} {c}"))
            scene.add(rng.stops(joint, 1e5, coordinate=c, name=f"stops {k} {c}"))
    system, state = scene.compile()
    return (system,), *pushed(rng, system, state), none(), rng.step(0.01)


def tree(rng: Chance):
    """Eight links in two branches; stops, brakes and springs here and there."""
    scene, links, dt = nc.Scene(), [nc.ground], rng.step(0.01)
    scene.add(rng.gravity())
    for k in range(8):
        parent = 1 if k == 4 else k
        place = np.array([0.3 * (k if k < 4 else k - 3), 0.0 if k < 4 else 0.3, 0.0])
        links.append(scene.add(rng.body(place, f"link {k}", 0.15)))
        joint = nc.Revolute(links[parent], links[-1], point=place, axis=rng.direction(), name=f"hinge {k}")
        joint = scene.add(joint)
        scene.add(rng.stops(joint, 1e5, name=f"stops {k}"))
        scene.add(
            rng.brake(joint, dt, name=f"brake {k}") if k % 2 else rng.two_stage(joint, name=f"spring {k}")
        )
    system, state = scene.compile()
    return (system,), *started(rng, system, state, 0.3), none(), dt
