"""Scenes of contacts by pair of shapes and by law: two bodies in space that are about to collide.

All is in space, so that energy, momentum and angular momentum count; a plane is that of a table that flies
and turns. Other numbers of a pair and a law (turns, speeds, restitutions) share its compiled programs.
"""

from typing import Any

import jax
import numpy as np
import tolerances as tol

import natcoord_jax as nc

FLOOR = nc.Plane(normal=(0, 0, 1))
BALL = {"shape": nc.Sphere(0.1), "density": 1 / (4 / 3 * np.pi * 1e-3)}  # of 1 kg
RUBBER = nc.Elastic(E=1e4, nu=0.3, density=10.0)
SECTION = nc.CircularSection(radius=0.02, E=1e6, density=1000.0)

SHAPES = {
    "sphere": nc.Sphere(0.1),
    "capsule": nc.Capsule(0.06, 0.3),
    "box": nc.Box((0.3, 0.2, 0.1)),
    "ellipsoid": nc.Ellipsoid((0.2, 0.15, 0.1)),
    "cylinder": nc.Cylinder(0.1, 0.2),
}
PAIRS = (
    "sphere, sphere",
    "sphere, capsule",
    "capsule, capsule",
    "sphere, box",
    "capsule, box",
    "box, box",
    "point, plane",
    "sphere, plane",
    "capsule, plane",
    "box, plane",
    "ellipsoid, plane",
    "cylinder, plane",
)
"""What flies in, and what it meets."""

LAWS: dict[str, dict[str, Any]] = {
    "soft": {"stiffness": 2e4},
    "lossy": {"stiffness": 2e4, "restitution": 0.5, "speed": 2.0},
    "Hertz": {"stiffness": 2e5, "law": "hertz", "restitution": 0.5, "speed": 2.0},
    "rubbing": {"stiffness": 2e4, "friction": 0.3},
    "hard": {"restitution": 1.0},
    "hard and rubbing": {"restitution": 0.5, "friction": 0.3},
}
HARD = [name for name in LAWS if "hard" in name]

TURNS = {
    "flat": ((0, 0, 1), 0.3),
    "edge": ((1, 0, 0), np.pi / 4),
    "corner": ((1, 1, 0), 0.9),
}
"""Of what flies in, beside the other one."""


def meeting(pair: str, law: str, *, turn: str = "corner", **numbers: Any) -> tuple[Any, Any]:
    """A rigid body on its way to another one that moves as well; `numbers`: of the contact, instead."""
    first, second = pair.split(", ")
    scene, moving = nc.Scene(), {"velocity": (0, 0, 0.3), "angular_velocity": (0.2, 0.1, 0.5)}
    if second == "plane":
        table = scene.add(nc.RigidBody(mass=5.0, inertia=(1.0, 1.2, 1.5), position=(0, 0, -0.2), **moving))
        target: Any = nc.Plane(normal=(0.1, 0, 1), body=table)
    else:
        lying = {"orientation": ((0, 1, 0), np.pi / 2)} if second == "capsule" else {}
        target = scene.add(nc.RigidBody(shape=SHAPES[second], density=500.0, **lying, **moving))
    flying = {"position": (0.03, 0.02, 0.3), "velocity": (0.1, 0, -1.5), "name": "flying"}
    if first == "point":
        body = scene.add(nc.PointMass(mass=2.0, **flying))
    else:
        flying |= {"orientation": TURNS[turn], "angular_velocity": (1.0, 0.5, 2.0)}
        body = scene.add(nc.RigidBody(shape=SHAPES[first], density=500.0, **flying))
    numbers = LAWS[law] | numbers
    if pair == "box, box" and "stiffness" in numbers and "friction" in numbers:
        # Of a smaller radius edges overlap by two of them, and touch where their distance has no direction.
        numbers["rounding"] = 0.02
    scene.add(nc.Contact(body, target, name="impact", **numbers))
    return scene.compile()


def solids(size: int = 1, stiffness: Any = None, **contact: Any) -> tuple[Any, Any]:
    """Two blocks that hit each other with their faces, off their middles; numbers of the contact."""
    scene, mesh = nc.Scene(), nc.mesh.box((1, 1, 1), (size,) * 3)
    one = scene.add(nc.Solid(mesh, material=RUBBER, angular_velocity=(0, 0, 0.3), name="one"))
    place = {"position": (0.2, 0.1, 1.01), "velocity": (0.6, 0.2, -2.0)}
    other = scene.add(nc.Solid(mesh, material=RUBBER, name="other", **place))
    numbers = contact if stiffness is None else {"stiffness": stiffness, **contact}
    scene.add(nc.Contact(other.face("z0"), one.face("z1"), name="impact", **numbers))
    return scene.compile()


def _table(scene: Any) -> nc.Plane:
    """A plane of a body that flies and turns."""
    moving = {"velocity": (0, 0, 0.3), "angular_velocity": (0.1, 0.2, 1.0), "position": (0, 0, -0.2)}
    return nc.Plane(normal=(0, 0, 1), body=scene.add(nc.RigidBody(mass=20.0, inertia=(4, 4, 5), **moving)))


def _block(scene: Any, **placing: Any) -> Any:
    moving = {"velocity": (0.5, 0.2, -2.0), **placing}
    return scene.add(nc.Solid(nc.mesh.box((1, 1, 1), (1, 1, 1)), material=RUBBER, **moving))


def _solid_on_plane(**contact: Any) -> Any:
    scene = nc.Scene()
    plane, block = _table(scene), _block(scene, position=(-0.5, -0.5, 0.02))
    scene.add(nc.Contact(block.face("z0"), plane, name="impact", **contact))
    return scene.compile()


def _sphere_on_solid(**contact: Any) -> Any:
    """A ball that meets a corner."""
    scene = nc.Scene()
    block = _block(scene, velocity=(0, 0, 0))
    ball = {"shape": nc.Sphere(0.3), "density": 20.0, "angular_velocity": (1.0, 0.5, 0.2)}
    ball = scene.add(nc.RigidBody(**ball, position=(1.1, 1.0, 1.35), velocity=(0, 0, -2.0)))
    scene.add(nc.Contact(block, ball, name="impact", **contact))
    return scene.compile()


def _shell_on_solid(**contact: Any) -> Any:
    scene = nc.Scene()
    block = _block(scene, velocity=(0, 0, 0.5))
    plate = nc.Shell(
        nc.mesh.rectangle((1.2, 1.1), (1, 1)),
        thickness=0.05,
        material=nc.Elastic(E=1e5, nu=0.3, density=100.0),
        position=(-0.1, 0.05, 1.05),
        orientation=((1, 0, 0), 0.02),
        velocity=(0, 0, -1.5),
    )
    scene.add(nc.Contact(scene.add(plate), block.face("z1"), name="impact", **contact))
    return scene.compile()


def _beams(**contact: Any) -> Any:
    """Two that cross."""
    scene = nc.Scene()
    one = scene.add(nc.Beam(SECTION, [(-0.5, 0, 0.06), (0.5, 0, 0.06)], elements=2, velocity=(0, 0, -1.0)))
    two = scene.add(nc.Beam(SECTION, [(0, -0.4, 0), (0, 0.4, 0)], elements=2, velocity=(0.2, 0, 0.3)))
    scene.add(nc.Contact(one, two, name="impact", **contact))
    return scene.compile()


def _beam_on_plane(**contact: Any) -> Any:
    scene = nc.Scene()
    plane = _table(scene)
    ends = [(-0.5, 0, 0.05), (0.5, 0.1, 0.1)]
    scene.add(nc.Contact(scene.add(nc.Beam(SECTION, ends, elements=2, velocity=(0.3, 0, -2.0))), plane,
                         name="impact", **contact))  # fmt: skip
    return scene.compile()


LOSSY = {"restitution": 0.5, "speed": 2.0}
FLEXIBLE: dict[str, tuple[Any, dict[str, Any], float]] = {
    "solid, solid": (solids, {"stiffness": 2e3}, 4e-3),
    "solid, solid: lossy": (solids, {"stiffness": 2e3, **LOSSY}, 4e-3),
    "solid, solid: rubbing": (solids, {"stiffness": 2e3, "friction": 0.4}, 4e-3),
    "solid, solid: mortar": (solids, {"method": "mortar"}, 4e-3),
    "solid, plane": (_solid_on_plane, {}, 4e-3),
    "solid, plane: rubbing": (_solid_on_plane, {"friction": 0.4}, 4e-3),
    "solid, sphere": (_sphere_on_solid, {"stiffness": 2e3}, 4e-3),
    "shell, solid": (_shell_on_solid, {"stiffness": 2e3}, 4e-3),
    "beam, beam": (_beams, {"stiffness": 2e3}, 2e-3),
    "beam, plane": (_beam_on_plane, {"stiffness": 2e4}, 2e-3),
    "beam, plane: rubbing": (_beam_on_plane, {"stiffness": 2e4, "friction": 0.3}, 2e-3),
}
"""Of what is flexible: scenes, numbers of the contact, steps [s]."""


def assert_never_gains(system: Any, trajectory: Any, *, bound: float = tol.ENERGY_OF_A_SMALL_SCENE) -> Any:
    """Energy balances with what is booked, and no step gains any; the balance."""
    balance = nc.balance(system, trajectory)
    assert balance.energy.max() <= bound
    energy = system.energy(trajectory)
    total = np.asarray(energy.total)
    scale = max(np.abs(total).max(), np.asarray(energy.kinetic).max())
    assert np.diff(total).max() <= bound * scale
    return balance


def stored(system: Any, trajectory: Any, name: str = "impact") -> Any:
    """Energy that contacts of a name hold at the saved times."""
    stores = system.energy(trajectory).stores
    return sum(np.asarray(x) for key, x in stores.items() if key.startswith(name))


def lost(system: Any, trajectory: Any, name: str = "impact") -> Any:
    """What contacts of a name have lost by the saved times, negative."""
    return sum(np.asarray(x) for key, x in system.work(trajectory).items() if key.startswith(name))


def last(trajectory: Any) -> Any:
    """The state at the end."""
    return jax.tree.map(lambda x: x[-1], trajectory.states)
