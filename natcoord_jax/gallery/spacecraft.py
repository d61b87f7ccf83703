"""The spacecraft of the paper (8.1): a free base with three motor-driven wheels, with two torque formulas."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import natcoord_jax as nc
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.markers import Marker
from natcoord_jax.gallery.example import Example

# Table 1 of the paper: mass [kg], diagonal of E [kg m^2], distance of the wheel from the base's centre [m].
BASE = (1005.3096, (89.3609, 201.0619, 357.4434))
WHEELS = (
    (424.1150, (8.8357, 106.0288, 106.0288), 0.9167),
    (424.1150, (106.0288, 8.8357, 106.0288), 1.25),
    (424.1150, (106.0288, 106.0288, 8.8357), 1.5833),
)
TORQUE = 200.0
"""Torque of every motor [N m]."""
T_END = 5.0
"""End of the manoeuvre [s]."""

# T(5) [J] with (61), T(5) with (70), J_3(5) [kg m^2/s] with (70), by the number of steps.
TABLE = {
    5: (7208.728, 3103.4, -336.0),
    10: (7626.4, 4926.3, -212.0),
    20: (7788.9, 6584.6, -91.3),
    40: (7825.0, 7443.3, -28.6),
    80: (7833.428, 7730.8, -7.65),
}


class CovariantJointTorque(nc.Force):
    """Motor torque through the covariant directors, f^i = m x d_i / 2 (70): not balanced at finite steps.

    It is here to show what goes wrong with it; `nc.JointTorque` uses the contravariant directors (61).

    Attributes:
        markers: the axis in the parent, three directions of the parent, three of the child.
    """

    kind: ClassVar[str] = "covariant joint torque"
    inputs: ClassVar[int] = 1

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> nc.Load:
        """Forces m x d_i / 2 on the directors of the child, their opposite on those of the parent."""
        half = 0.5 * inputs[0] * x[0]
        forces = jnp.concatenate([jnp.zeros((1, 3)), -jnp.cross(half, x[1:4]), jnp.cross(half, x[4:7])])
        return nc.Load(forces, jnp.zeros_like(x))


def axes_of(body: Handle) -> tuple[Marker, ...]:
    """The three axes of a body, as directions."""
    return tuple(nc.Direction(body, axis, local=True) for axis in np.eye(3))


def _craft(
    working: tuple[int, ...] = (1, 2, 3),
) -> tuple[nc.Scene, list[tuple[Handle, Handle, Handle]]]:
    """The scene without motors, and (base, wheel, hinge) of each working wheel; the others are locked."""
    scene = nc.Scene()
    base = scene.add(nc.RigidBody(mass=BASE[0], second_moment=BASE[1], name="base"))
    parts = []
    for number, (mass, moment, distance) in enumerate(WHEELS):
        axis = np.eye(3)[number]
        place = distance * axis
        body = nc.RigidBody(mass=mass, second_moment=moment, position=place, name=f"wheel {number + 1}")
        wheel = scene.add(body)
        if number + 1 not in working:
            scene.add(nc.Fixed(base, wheel, point=place, name=f"lock {number + 1}"))
            continue
        hinge = scene.add(nc.Revolute(base, wheel, point=place, axis=axis, name=f"hinge {number + 1}"))
        parts.append((base, wheel, hinge))
    return scene, parts


def spacecraft(working: tuple[int, ...] = (1, 2, 3)) -> Example:
    """Free base with three motor-driven wheels, 200 N m each, from rest over 5 s (8.1 of the paper)."""
    scene, parts = _craft(working)
    for number, (_, _, hinge) in zip(sorted(working), parts):
        scene.add(nc.JointTorque(hinge, name=f"motor {number}"))
    system, state = scene.compile()
    return Example(
        name="spacecraft",
        description="free base with three motor-driven wheels (8.1 of the paper)",
        system=system,
        state=state,
        dt=T_END / 100,
        steps=100,
        control=lambda t: jnp.full((t.shape[0], len(working)), TORQUE),
        facts={"dofs": 6 + len(working), "constraints": 39, "table": TABLE, "converged_energy": 7836.18288},
        figure=torque_figure,
    )


class Comparison(NamedTuple):
    """One rollout of the comparison of torque formulas.

    Attributes:
        formula: "contravariant" (61) or "covariant" (70).
        steps: number of steps N.
        t: times (N + 1,) [s].
        angular_momentum: third component of J (N + 1,) [kg m^2/s].
        energy: kinetic energy (N + 1,) [J].
    """

    formula: str
    steps: int
    t: np.ndarray
    angular_momentum: np.ndarray
    energy: np.ndarray


def compare_torques(numbers: tuple[int, ...] = tuple(TABLE)) -> list[Comparison]:
    """Rollouts with both torque formulas and several numbers of steps, figures 4 and 5 of the paper.

    The craft carries motors of both kinds, with inputs of their own; a lane drives one kind and leaves the
    other idle. So all lanes differ in numbers only and share one compiled program: every lane makes as many
    steps as the longest, the shorter ones coast after the end of their manoeuvre, and that is cut off.

    Args:
        numbers: numbers of steps over [0, 5] s.

    Returns:
        One entry for each formula and number.

    Raises:
        RuntimeError: if a manoeuvre does not converge.
    """
    scene, parts = _craft()
    for number, (base, wheel, hinge) in enumerate(parts):
        scene.add(nc.JointTorque(hinge, name=f"motor {number + 1}"))
        markers = (nc.Direction(base, np.eye(3)[number]), *axes_of(base), *axes_of(wheel))
        scene.add(CovariantJointTorque(markers, name=f"covariant motor {number + 1}"))
    system, state = scene.compile()
    longest = max(numbers)
    kinds = {"contravariant": [1.0, 0.0] * 3, "covariant": [0.0, 1.0] * 3}
    lanes = [(formula, n) for formula in kinds for n in numbers]

    def drive(formula: str, n: int) -> Array:
        return TORQUE * (jnp.arange(longest) < n)[:, None] * jnp.asarray(kinds[formula])

    @eqx.filter_jit
    def run(dt: Float[Array, ""], inputs: Float[Array, "steps 6"]) -> tuple[Any, ...]:
        trajectory = nc.simulate(system, state, dt=dt, inputs=inputs)
        third = system.angular_momentum(trajectory)[:, 2]
        return trajectory.failed_step, third, system.energy(trajectory).kinetic

    steps = jnp.array([T_END / n for _, n in lanes])
    results = jax.vmap(run)(steps, jnp.stack([drive(*lane) for lane in lanes]))
    found = []
    for (formula, n), failed, momentum, energy in zip(lanes, *map(np.asarray, results), strict=True):
        if failed < n:
            raise RuntimeError(f"{n} steps with the {formula} torque failed in step {failed}")
        t = np.linspace(0.0, T_END, n + 1)
        found.append(Comparison(formula, n, t, momentum[: n + 1], energy[: n + 1]))
    return found


READING = (
    "From rest, three motors turn the wheels, and the base turns against them; nothing pushes from outside, "
    "so the angular momentum J stays zero.\n"
    "Torques by formula (61) of the paper keep it zero with any number N of steps, even 5, and the energy T "
    "is right from N = 20 on.\n"
    "By formula (70), which looks as good on paper, the craft gains angular momentum from nowhere, and at "
    "N = 5 the energy is less than half."
)
"""What there is to see in the figure."""


def torque_figure(phases: nc.Phases) -> Any:
    """The craft, and figures 4 and 5 of the paper: J_3 and T with both torque formulas, N = 5 ... 80.

    Args:
        phases: a run of the scene, for the pictures.
    """
    from natcoord_jax.viz import Curve, Panel, plot_snapshots

    comparisons = compare_torques()
    panels = []
    for title, ordinate, field in (
        ("angular momentum", "J₃ [kg m²/s]", "angular_momentum"),
        ("kinetic energy", "T [J]", "energy"),
    ):
        found: dict[str, list[Any]] = {}
        for c in comparisons:
            found.setdefault(c.formula, []).append(Curve(f"N = {c.steps}", c.t, getattr(c, field)))
        # Both on one scale: what is kept is to be seen as that, and not its round-off.
        every = np.concatenate([curve.values for curves in found.values() for curve in curves])
        room = 0.05 * float(np.ptp(every))
        for formula, number in (("contravariant", 61), ("covariant", 70)):
            limits = float(every.min()) - room, float(every.max()) + room
            name = f"{title}, {formula} torque ({number})"
            panels.append(Panel(name, ordinate, found[formula], limits=limits))
    return plot_snapshots(phases, (0.0, 1.5, 3.0, 4.5), panels, caption=READING)
