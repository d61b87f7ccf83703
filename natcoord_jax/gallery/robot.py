"""A lightweight robot mounts a flexible cable (8.2 of the paper)."""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import natcoord_jax as nc
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.gallery.example import Example
from natcoord_jax.gallery.trees import ROBOT
from natcoord_jax.maths.rotations import from_axis_angle
from natcoord_jax.system import System

# Links of the KUKA LWR 4+: height of the frame above the foot with the arm upright [m], mass [kg], centre of
# mass (y, z) from there [m], inertia about it (xx, yy, zz, yz) [kg m^2]; products with x vanish. The numbers
# are those of lwr_description/urdf/lwr.urdf.xacro in github.com/kuka-isir/rtt_lwr (A. Hoarau, ISIR), with
# the decimal point of three inertias where mass and size of the link want it: there that of link 1 is ten
# times that of its mirror image, link 3, that of link 6 is that of a sphere of 23 cm instead of 7, that of
# link 7 that of a disc of 1.1 m instead of 4 cm.
LINKS = (
    (0.1020, 2.303399, (0.023327, 0.118146), (0.0156081, 0.0153468, 0.0044074, 0.0031917)),
    (0.3105, 2.303435, (-0.032746, 0.073656), (0.0142349, 0.0141320, 0.0042479, 0.0022809)),
    (0.5020, 2.303421, (-0.023330, 0.118150), (0.0156098, 0.0153477, 0.0044071, -0.0031922)),
    (0.7105, 2.303436, (0.032744, 0.073659), (0.0142337, 0.0141316, 0.0042482, -0.0022806)),
    (0.9020, 1.600598, (0.020775, 0.086205), (0.0088081, 0.0081352, 0.0035971, 0.0026144)),
    (1.1005, 1.493024, (-0.004518, -0.002953), (0.0029854, 0.0029983, 0.0032363, -0.0000025)),
    (1.1785, 0.108688, (0.0, -0.015815), (0.0000418, 0.0000418, 0.0000701, 0.0)),
)

# Angles of the hinges [rad] at given times [s], with rest at each: home, grip, lift, bend, turn, mount. All
# are within the robot's limits of 170 and, for every second hinge, 120 degrees.
TIMES = (0.0, 2.0, 5.0, 7.0, 10.0, 12.0)
WAY = (
    (0.00, -0.30, 0.00, 1.00, 0.00, -1.84, 0.00),
    (-0.71, -0.81, -0.05, 0.94, 0.03, -1.39, -0.75),
    (-0.23, -0.40, -0.10, 0.83, -0.44, -1.73, -0.43),
    (0.57, -0.50, -0.10, 0.87, -0.98, -2.08, 0.10),
    (0.73, -0.73, 0.03, 0.68, -1.03, -1.70, -0.10),
    (0.79, -0.67, -0.01, 1.08, -0.75, -1.89, 0.52),
)
GRIP = TIMES[1]
"""Time at which the gripper closes [s]."""
SNAPSHOTS = (0.0, 1.0, 2.0, 5.0, 6.0, 7.0, 10.0, 12.0)
"""Times of the snapshots of the paper's figure 7 [s]."""

FLANGE = 1.178
"""Height of the flange with the arm upright [m]: the gripper is on it."""
GRIPPER = (0.06, 0.04, 0.12)
PLUG = (0.04, 0.06, 0.04)
"""Edges [m]."""
DENSITIES = (2500.0, 1200.0)
"""Of gripper and plug [kg/m^3]."""
PLACE = (0.5, -0.45, 0.30)
"""Centre of the plug in its holder [m]; the cable leaves it along y."""
CABLE = {"radius": 0.01, "E": 2e7, "nu": 0.4, "density": 1500.0}
"""A soft cable: radius [m], Young's modulus [Pa], density [kg/m^3]."""
LENGTH = 1.0
"""Of the cable [m], unstressed and straight between plug and clamp."""
BANDWIDTH = 60.0
"""Of the feedback [1/s]: the bent cable pushes the light wrist out of some poses, at up to 40 a second."""


def way(t: Float[Array, ""]) -> Float[Array, "7"]:
    """Angles of the hinges at a time [s]: from rest to rest, with continuous jerk."""
    starts, ends = jnp.asarray(TIMES[:-1]), jnp.asarray(TIMES[1:])
    s = jnp.clip((t - starts) / (ends - starts), 0.0, 1.0)
    smooth = s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)
    points = jnp.asarray(WAY)
    return points[0] + smooth @ jnp.diff(points, axis=0)


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    return np.asarray(eager_numpy(from_axis_angle)(as_array(axis), as_array(angle)))


def _robot(scene: nc.Scene) -> Handle:
    """Links, hinges and motors at the first point of the way; the gripper."""
    carrier, origin, frame = nc.ground, np.zeros(3), np.eye(3)
    # The pose takes a place and a direction of the upright arm to where the links are.
    rotation, shift = np.eye(3), np.zeros(3)
    for k, ((alpha, d), (height, mass, (y, z), (xx, yy, zz, yz))) in enumerate(zip(ROBOT, LINKS)):
        axis, point = rotation @ frame[:, 2], rotation @ origin + shift
        turn = _turn(axis, WAY[0][k])
        rotation, shift = turn @ rotation, turn @ (shift - point) + point
        link = nc.RigidBody(
            mass=mass,
            inertia=((xx, 0.0, 0.0), (0.0, yy, yz), (0.0, yz, zz)),
            com=(0.0, y, z),
            position=rotation @ (0.0, 0.0, height) + shift,
            orientation=rotation,
            name=f"link {k + 1}",
        )
        body = scene.add(link)
        hinge = scene.add(nc.Revolute(carrier, body, point=point, axis=axis, name=f"hinge {k + 1}"))
        scene.add(nc.JointTorque(hinge, name=f"motor {k + 1}"))
        carrier, origin = body, origin + d * frame[:, 2]
        frame = frame @ _turn(np.array([1.0, 0.0, 0.0]), np.deg2rad(alpha))
    centre = (0.0, 0.0, FLANGE + 0.5 * GRIPPER[2])
    shape = {"shape": nc.Box(GRIPPER), "density": DENSITIES[0]}
    at = {"position": rotation @ centre + shift, "orientation": rotation}
    gripper = scene.add(nc.RigidBody(**shape, **at, name="gripper"))
    scene.add(nc.Fixed(carrier, gripper, name="flange"))
    return gripper


def _compiled(
    elements: int, *, robot: bool = True, gripped: bool = False
) -> tuple[System, State, nc.BeamHandle]:
    """Cable, plug and, on request, the robot: with the plug in its holder, or in the gripper."""
    scene = nc.Scene()
    scene.add(nc.Gravity(name="gravity"))
    gripper = _robot(scene) if robot else None
    plug = scene.add(nc.RigidBody(shape=nc.Box(PLUG), density=DENSITIES[1], position=PLACE, name="plug"))
    if gripped:
        scene.add(nc.Fixed(gripper, plug, name="grip"))
    else:
        scene.add(nc.Fixed(nc.ground, plug, name="holder"))
    start = np.array(PLACE) + (0.0, 0.5 * PLUG[1], 0.0)
    curve = [start, start + (0.0, LENGTH, 0.0)]
    section = nc.CircularSection(**CABLE)
    ends = {"start": plug, "end": nc.ground}
    cable = scene.add(nc.Beam(section, curve, elements=elements, **ends, second=(1, 0, 0), name="cable"))
    return (*scene.compile(), cable)


def _tracked(system: System, state: State, steps: int, dt: float, options: dict[str, Any]) -> Trajectory:
    """A phase: the run along the way with computed torques, the cable taken into account."""
    times = state.t + dt * jnp.arange(1, steps + 1)
    path = jax.vmap(way)(times) - jnp.asarray(WAY[0])
    control = nc.computed_torque(system, state, path, dt=dt, bandwidth=BANDWIDTH)
    return nc.simulate(system, state, dt=dt, steps=steps, inputs=control, **options)


class Mounting(NamedTuple):
    """The systems before and after the grip, the first state, and the cable."""

    approach: System
    gripped: System
    state: State
    cable: nc.BeamHandle


@lru_cache(maxsize=2)
def mounting(elements: int = 40) -> Mounting:
    """Compile the systems, and let the cable hang between holder and clamp."""
    alone, straight, _ = _compiled(elements, robot=False)
    hanging = nc.equilibrium(alone, straight, steps=1).state
    approach, state, cable = _compiled(elements)
    _, state = nc.transfer(alone, hanging, approach, onto=state)
    gripped, _, _ = _compiled(elements, gripped=True)
    return Mounting(approach, gripped, eqx.tree_at(lambda s: s.t, state, jnp.zeros(())), cable)


def mount(elements: int, steps: int, dt: float, **options: Any) -> nc.Phases:
    """The run: to the plug, where the gripper closes, and on with it.

    Args:
        elements: of the cable.
        steps: number of steps; the gripper closes after the step that ends next to its time.
        dt: step [s].
        options: of `nc.simulate`; torques are those that the energy-momentum step needs.

    Returns:
        One phase if the run ends before the grip or fails there, else two.
    """
    parts = mounting(elements)
    before = min(steps, max(1, round(GRIP / dt)))
    first = _tracked(parts.approach, parts.state, before, dt, options)
    if before == steps or not Result(int(first.result)).ok:
        return nc.Phases((parts.approach,), (first,))
    reached = jax.tree.map(lambda x: x[-1], first.states)
    gripped, state = nc.transfer(parts.approach, reached, parts.gripped)
    second = _tracked(gripped, state, steps - before, dt, options)
    return nc.Phases((parts.approach, gripped), (first, second))


def figure(parts: Mounting, phases: nc.Phases) -> Any:
    """Figures 7 and 8 of the paper: snapshots; total, potential and strain energy."""
    from natcoord_jax.viz import Curve, Panel, plot_snapshots

    energy, t = phases.energy(), np.asarray(phases.t)
    gravity = np.asarray(energy.stores["gravity"])
    strain = np.asarray(energy.potential) - gravity
    curves = [
        Curve("total", t, np.asarray(energy.total)),
        Curve("potential, of gravity", t, gravity),
        Curve("strain", t, strain, dashed=True),
    ]
    panels = [
        Panel("energies", "[J]", curves),
        Panel("strain energy of the cable", "[J]", [Curve("strain", t, strain)]),
    ]
    return plot_snapshots(phases, SNAPSHOTS, panels, beams=(parts.cable,))


def robot_cable(elements: int = 40) -> Example:
    """A lightweight robot grips the plug of a cable and bends it on the way to its socket (8.2).

    Seven hinges with the Denavit-Hartenberg rows of the paper, links of the KUKA LWR 4+ (see `LINKS`), a
    gripper, a plug that rests in a holder on the ground, and a soft cable from the plug to a clamp. At first
    the cable hangs at rest. After 2 s the gripper, at rest, closes around the plug as the holder lets go;
    from then on computed torques bend the cable to a hook. The robot stands on a pedestal: there is no floor.

    Args:
        elements: of the cable.
    """
    parts = mounting(elements)
    return Example(
        name="robot_cable",
        description="a robot mounts a flexible cable",
        system=parts.approach,
        state=parts.state,
        dt=0.01,
        steps=1200,
        facts={"dofs": 7 + 6 * (elements - 1), "grip": GRIP, "snapshots": SNAPSHOTS},
        phases=partial(mount, elements),
        figure=partial(figure, parts),
        beams=(parts.cable,),
    )
