"""Contracts that every effect of the library keeps, over one table of all of them.

Each effect is put into a pair of bodies and shown a random motion of about one radian, as a step would show
it. What it answers must be consistent with itself: power with forces, energy with power, constraint forces
with constraint rates, and nothing may push or turn the pair as a whole that acts within it.
"""

import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import STEPS, assert_v_of_errors, assert_v_shaped, errors_of_lanes, lanes_along
from scenes import AXIS, JOINTS, SECOND, SPECIAL, with_multipliers

import natcoord_jax as nc
import natcoord_jax.effects
from natcoord_jax.build import build
from natcoord_jax.core.cells import CELLS
from natcoord_jax.core.coordinate import CoordinateEffect
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.joint import frames_at
from natcoord_jax.core.potential import place_markers
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.rotations import from_rotation_vector
from natcoord_jax.mechanics.reduced import ReducedStep
from natcoord_jax.mechanics.response import gather, respond, situation
from natcoord_jax.model.rows import group_places, rows_with_ground
from natcoord_jax.stepping.step import advance

TABLEAU = gauss(1)
pytestmark = pytest.mark.users
SEEDS = (0, 1, 2)


@dataclass
class Parts:
    """What an effect of the table can be attached to."""

    one: Any
    two: Any
    joint: Any

    @property
    def ends(self):
        """A point on each body."""
        return nc.Point(self.one, (0.0, -0.4, -1.2)), nc.Point(self.two, (0.8, 0.4, -1.9))

    @property
    def triad(self):
        """The axes of the first body's start, carried by it."""
        return tuple(nc.Direction(self.one, axis) for axis in np.eye(3))

    @property
    def attached(self):
        """An attachment on each body, with an arm and axes of its own."""
        turned = from_rotation_vector(jnp.array([0.3, -0.2, 0.5]))
        first = nc.Attachment(self.one, (0.1, 0.0, -1.2), turned)
        return first, nc.Attachment(
            self.two, (0.4, 0.4, -1.9), from_rotation_vector(jnp.array([0.1, 0.4, 0.2]))
        )

    @property
    def three(self):
        """Two attachments on the first body and one on the second."""
        middle = nc.Attachment(self.one, (0.2, 0.2, -1.5), np.eye(3))
        return self.attached[0], middle, self.attached[1]

    @property
    def four(self):
        """Attachments at the corners of a warped quadrilateral, two on each body, their first axes across."""
        places = (0.0, -0.4, -1.2), (0.9, -0.3, -1.1), (0.8, 0.4, -1.3), (-0.1, 0.3, -1.2)
        axes, bodies = np.roll(np.eye(3), 1, axis=1), (self.one, self.two, self.two, self.one)
        return tuple(nc.Attachment(b, x, axes) for b, x in zip(bodies, places))

    def cell(self, count):
        """Points of a distorted cell of a solid, some on each body."""
        nodes = CELLS[count].nodes
        bend = 0.03 * np.sin(3.0 * np.roll(nodes, 1, axis=1))
        places = (
            (2.0 if count == 10 else 1.0) * nodes * np.array([1.0, 0.9, 1.1])
            + bend
            + np.array([0.4, 0.0, -0.8])
        )
        return tuple(nc.Point(self.one if x[2] < 0 else self.two, x0) for x, x0 in zip(nodes - 0.1, places))

    @property
    def eight(self):
        """Points at the corners of a distorted brick, four on each body."""
        face = np.array([(0.0, -0.4, -1.2), (0.9, -0.3, -1.1), (0.8, 0.4, -1.3), (-0.1, 0.3, -1.2)])
        above = face + np.array([(0.1, 0.0, 0.7), (0.0, 0.1, 0.8), (0.0, 0.0, 0.7), (0.1, 0.1, 0.9)])
        return tuple(nc.Point(b, x) for b, xs in ((self.one, face), (self.two, above)) for x in xs)


@dataclass(frozen=True)
class Entry:
    """How to make an effect, and what to expect of it.

    Attributes:
        make: from the parts of the pair.
        joint: of the pair.
        inside: it acts between the two bodies, so it neither pushes nor turns the pair.
        constraints: of a joint.
    """

    make: Callable[[Parts], Effect] | None = None
    joint: type = nc.Spherical
    inside: bool = True
    constraints: int | None = None


def _law(x):
    return jnp.cosh(x) + 0.3 * x**3


def _wave(t):
    return jnp.stack([jnp.sin(t), jnp.cos(t), t])


STIFFNESS = np.diag([30.0, 40.0, 50.0, 2.0, 3.0, 4.0]) + 0.5
# Of three nodes at two Gauss points.
SHAPES = {
    "values": np.array([[0.5, 0.6, -0.1], [-0.1, 0.6, 0.5]]),
    "slopes": np.array([[-2.0, 2.2, -0.2], [0.2, -2.2, 2.0]]),
    "weights": np.array([0.4, 0.5]),
}


TABLE = {
    nc.Fixed: Entry(joint=nc.Fixed, constraints=6),
    nc.Spherical: Entry(joint=nc.Spherical, constraints=3),
    nc.Revolute: Entry(joint=nc.Revolute, constraints=5),
    nc.Universal: Entry(joint=nc.Universal, constraints=4),
    nc.Cylindrical: Entry(joint=nc.Cylindrical, constraints=4),
    nc.Prismatic: Entry(joint=nc.Prismatic, constraints=5),
    nc.Planar: Entry(joint=nc.Planar, constraints=3),
    nc.Screw: Entry(joint=nc.Screw, constraints=4),
    nc.Distance: Entry(joint=nc.Distance, constraints=1),
    nc.Drive: Entry(lambda p: nc.Drive(p.joint, function=jnp.sin, coordinate=1), nc.Universal),
    nc.Coupling: Entry(
        lambda p: nc.Coupling((p.joint,) * 2, factors=(1.0, -0.7), coordinate=(0, 1)), nc.Cylindrical
    ),
    nc.ShellElement: Entry(
        lambda p: nc.ShellElement(p.four, thickness=0.1, material=nc.Elastic(E=300.0, nu=0.3))
    ),
    nc.MembraneElement: Entry(
        lambda p: nc.MembraneElement(
            (*p.eight[:2], *p.eight[5:7]), thickness=0.1, material=nc.Elastic(E=300.0)
        )
    ),
    nc.ShellTriangle: Entry(
        lambda p: nc.ShellTriangle(
            p.four[:3], thickness=0.1, material=nc.Elastic(E=300.0, nu=0.3), prestress=(9.0, 4.0, 1.0)
        )
    ),
    nc.MembraneTriangle: Entry(
        lambda p: nc.MembraneTriangle((*p.eight[:2], p.eight[5]), thickness=0.1, material=nc.Elastic(E=300.0))
    ),
    nc.Brick: Entry(lambda p: nc.Brick(p.eight, material=nc.Elastic(E=50.0, nu=0.3))),
    **{
        element: Entry(lambda p, e=element, count=count, law=law: e(p.cell(count), material=law))
        for element, count, law in (
            (nc.Hexahedron8, 8, nc.CompressibleMooneyRivlin(c10=8.0, c01=3.0, volume_stiffness=9.0)),
            (nc.Hexahedron20, 20, nc.NeoHooke(E=50.0, nu=0.3)),
            (nc.Hexahedron27, 27, nc.Elastic(E=50.0, nu=0.3)),
            (nc.Hexahedron27P1, 27, nc.NeoHooke(E=50.0, nu=0.4)),
            (nc.Tetrahedron10, 10, nc.MooneyRivlin(c10=8.0, c01=3.0, bulk_modulus=60.0)),
            (nc.Tetrahedron10P0, 10, nc.NeoHooke(E=50.0, nu=0.4)),
        )
    },
    nc.FacePressure6: Entry(
        lambda p: nc.FacePressure6([p.cell(10)[k] for k in (0, 1, 2, 4, 5, 6)], pressure=jnp.sin),
        inside=False,
    ),
    nc.FacePressure8: Entry(
        lambda p: nc.FacePressure8([p.cell(20)[k] for k in CELLS[20].faces[2]], pressure=jnp.sin),
        inside=False,
    ),
    nc.FacePressure9: Entry(
        lambda p: nc.FacePressure9([p.cell(27)[k] for k in CELLS[27].faces[2]], pressure=jnp.sin),
        inside=False,
    ),
    nc.GapPotential: Entry(
        lambda p: nc.GapPotential(
            (*p.eight[:2], *p.eight[5:7]), nc.CapsuleOnCapsule(radii=(0.6, 0.7)), stiffness=9.0
        )
    ),
    nc.GapConstraint: Entry(
        lambda p: nc.GapConstraint(p.ends, nc.SphereOnSphere(radii=(0.1, 0.1)), restitution=0.5)
    ),
    nc.CapsuleContacts: Entry(
        lambda p: nc.CapsuleContacts(
            (
                *p.ends,
                nc.Point(p.one, (0.3, 0.1, -1.0)),
                nc.Point(p.one, (0.4, 0.9, 0.2)),
                p.ends[1],
                nc.Point(p.one, (0.1, 0.2, -0.4)),
            ),
            radii=(0.9, 1.0, 0.5),
            stiffness=9.0,
            skin=50.0,
        )
    ),
    nc.FrictionalGapPotential: Entry(
        lambda p: nc.FrictionalGapPotential(
            p.ends, nc.SphereOnSphere(radii=(0.6, 0.7)), stiffness=9.0, friction=0.3
        )
    ),
    nc.FrictionalNodeOnFacets: Entry(
        lambda p: nc.FrictionalNodeOnFacets(
            (p.ends[1], *p.eight[:4]),
            facets=[(1, 2, 3, 4)],
            thickness=2.0,
            two_sided=1.0,
            stiffness=9.0,
            friction=0.3,
            regularisation=0.01,
        )
    ),
    nc.MortarGap: Entry(
        lambda p: nc.MortarGap(
            p.eight, facets=[(0, 1, 2, 3)], others=[(7, 6, 5, 4)], thickness=4.0, stiffness=9.0
        )
    ),
    nc.NodeOnFacets: Entry(
        lambda p: nc.NodeOnFacets(
            (p.ends[1], *p.eight[:4]), facets=[(1, 2, 3, 4)], thickness=2.0, two_sided=1.0, stiffness=9.0
        )
    ),
    nc.FacePressure: Entry(
        lambda p: nc.FacePressure((*p.eight[:2], *p.eight[5:7]), pressure=jnp.sin), inside=False
    ),
    nc.EdgeSegment: Entry(
        lambda p: nc.EdgeSegment(p.four[:2], force=_wave, moment=(0.3, 0.2, 0.0), following=True),
        inside=False,
    ),
    nc.EnclosedGas: Entry(
        lambda p: nc.EnclosedGas(
            p.eight, faces=np.array(nc.mesh.HEXAHEDRON), gauge_pressure=0.0, ambient=30.0
        )
    ),
    nc.PointOnPlane: Entry(lambda p: nc.PointOnPlane((p.ends[0], p.triad[2], p.ends[1]), distance=0.2)),
    nc.PointOnLine: Entry(lambda p: nc.PointOnLine((p.ends[0], p.triad[2], p.ends[1]))),
    nc.PointOnPoint: Entry(
        lambda p: nc.PointOnPoint(tuple(nc.Point(body, (0.2, 0.1, -1.3)) for body in (p.one, p.two)))
    ),
    # Two points of one body whose mean is the point of the joint, on the other.
    nc.PointSum: Entry(
        lambda p: nc.PointSum(
            (nc.Point(p.one, (0.2, 0.1, -1.3)), *(nc.Point(p.two, (x, 0.1, -1.3)) for x in (0.8, -0.2))),
            weights=(-1.0, 0.4, 0.6),
        )
    ),
    nc.Rod: Entry(lambda p: nc.Rod(p.ends)),
    nc.Rolling: Entry(
        lambda p: nc.Rolling((p.ends[0], p.triad[2], p.ends[1], nc.Direction(p.two, AXIS)), radius=0.3)
    ),
    nc.Gravity: Entry(lambda p: nc.Gravity(vector=(1.0, -2.0, 3.0)), inside=False),
    nc.PointForce: Entry(
        lambda p: nc.PointForce((p.ends[0], *p.triad), force=_wave, following=True), inside=False
    ),
    nc.BodyTorque: Entry(lambda p: nc.BodyTorque(p.triad, torque=_wave, following=True), inside=False),
    nc.PairTorque: Entry(lambda p: nc.PairTorque((p.triad[0], nc.Direction(p.two, AXIS)), torque=0.7)),
    nc.JointTorque: Entry(lambda p: nc.JointTorque(p.joint, gear=2.0), nc.Planar),
    nc.JointForce: Entry(lambda p: nc.JointForce(p.joint, coordinate=1, gear=2.0), nc.Cylindrical),
    nc.AffineActuator: Entry(
        lambda p: nc.AffineActuator(
            (p.joint,) * 2, coordinate=(0, 1), gear=(2.0, -0.5), gain=(3.0, 0.4, 0.2), bias=(0.3, -5.0, -0.7)
        ),
        nc.Cylindrical,
    ),
    nc.WrenchInput: Entry(
        lambda p: nc.WrenchInput((p.ends[0], *p.triad), force=(1.0, 0.2, 3.0), torque=(0.0, 0.5, 0.1)),
        inside=False,
    ),
    nc.SphericalTorque: Entry(
        lambda p: nc.SphericalTorque((p.triad[0], nc.Direction(p.two, AXIS)), gear=2.0)
    ),
    nc.BodyTorqueInput: Entry(lambda p: nc.BodyTorqueInput(p.triad), inside=False),
    nc.BodyForceInput: Entry(lambda p: nc.BodyForceInput((p.ends[0], p.triad[1])), inside=False),
    nc.Spring: Entry(lambda p: nc.Spring(p.ends, stiffness=5.0, length=0.3)),
    nc.QuadraticSpring: Entry(lambda p: nc.QuadraticSpring(p.ends, stiffness=5.0, length=0.3)),
    nc.NonlinearSpring: Entry(lambda p: nc.NonlinearSpring(p.ends, law=_law)),
    nc.Damper: Entry(lambda p: nc.Damper(p.ends, damping=5.0)),
    nc.JointSpring: Entry(
        lambda p: nc.JointSpring(p.joint, stiffness=5.0, rest=0.3, coordinate=1), nc.Universal
    ),
    nc.JointPotential: Entry(lambda p: nc.JointPotential(p.joint, law=_law), nc.Revolute),
    nc.JointStops: Entry(lambda p: nc.JointStops(p.joint, stiffness=9.0, lower=-0.1, upper=0.1), nc.Planar),
    nc.JointDamper: Entry(lambda p: nc.JointDamper(p.joint, damping=5.0), nc.Distance),
    nc.JointFriction: Entry(lambda p: nc.JointFriction(p.joint, friction=5.0), nc.Revolute),
    nc.SphericalSpring: Entry(lambda p: nc.SphericalSpring(p.attached, stiffness=5.0)),
    nc.SphericalDamper: Entry(
        lambda p: nc.SphericalDamper((p.triad[0], nc.Direction(p.two, AXIS)), damping=5.0)
    ),
    nc.Armature: Entry(lambda p: nc.Armature(p.joint, inertia=5.0), nc.Revolute),
    nc.BeamElement: Entry(lambda p: nc.BeamElement(p.attached, length=0.8, stiffness=STIFFNESS)),
    nc.NonlinearBeamElement: Entry(
        lambda p: nc.NonlinearBeamElement(
            p.attached, length=0.8, stiffness=STIFFNESS, law=lambda e: jnp.sum(jnp.cosh(e))
        )
    ),
    nc.BeamDamping: Entry(lambda p: nc.BeamDamping(p.attached, length=0.8, viscosity=STIFFNESS)),
    nc.DirectorElement: Entry(
        lambda p: nc.DirectorElement(p.three, stiffness=STIFFNESS, reference=np.full((2, 6), 0.1), **SHAPES)
    ),
    nc.DirectorDamping: Entry(lambda p: nc.DirectorDamping(p.three, viscosity=STIFFNESS, **SHAPES)),
}
REVERSED = (
    nc.Revolute, nc.Drive, nc.Rod, nc.Rolling, nc.Spring, nc.JointSpring, nc.SphericalSpring, nc.BeamElement,
    nc.ShellElement, nc.Hexahedron8, nc.EnclosedGas, nc.GapPotential, nc.GapConstraint, nc.PointForce,
    nc.JointTorque, nc.Damper,
)  # fmt: skip
"""One effect of each sort, whose reverse derivatives the slow lane asks for; all are asked exhaustively."""
EFFECTS = pytest.mark.parametrize("effect", TABLE, ids=lambda effect: effect.__name__)
JOINT_TYPES = pytest.mark.parametrize("joint", JOINTS.values(), ids=list(JOINTS))
# (Of contacts with friction the forces are unknowns: what they do is judged along motions.)
STORING = [e for e in TABLE if e.stores and not e.unilateral]


def exported() -> set[type]:
    """Every effect class that a module of `natcoord_jax.effects` exports."""
    found = set()
    for module in pkgutil.walk_packages(natcoord_jax.effects.__path__, "natcoord_jax.effects."):
        if module.ispkg:
            names = vars(importlib.import_module(module.name)).values()
            found |= {x for x in names if inspect.isclass(x) and issubclass(x, Effect)}
    return {x for x in found if not inspect.isabstract(x)}


# --- the table and the names ------------------------------------------------------------------------------


def test_every_effect_is_in_the_table():
    missing = {e.__name__ for e in exported() - set(TABLE)}
    assert not missing, f"add these effects to TABLE in tests/test_contracts.py: {sorted(missing)}"


def test_every_joint_is_in_the_scenes():
    """By that list the tests of all joints find them: here, and of conservation, orders and schemes."""
    missing = {e.__name__ for e in TABLE if issubclass(e, nc.Joint)} - {j.__name__ for j in JOINTS.values()}
    assert not missing, f"add these joints to JOINTS in tests/scenes.py: {sorted(missing)}"


def test_every_effect_is_public():
    hidden = {e.__name__ for e in exported() if getattr(nc, e.__name__, None) is not e}
    assert not hidden, f"add to the imports and __all__ of natcoord_jax/__init__.py: {sorted(hidden)}"


def test_kinds_tell_effects_apart():
    """The kind names the scope of an effect's operations and the part in messages."""
    kinds = [e.kind for e in TABLE]
    odd = [kind for kind in kinds if not re.fullmatch(r"[a-z]+( [a-z]+)*", kind)]
    assert not odd, f"kinds are words in small letters: {odd}"
    shared = sorted({kind for kind in kinds if kinds.count(kind) > 1})
    assert not shared, f"several effects share the kinds {shared}"


def test_docstrings_say_units():
    """A unit in brackets; numbers without any are marked [-]."""
    unit = re.compile(r"\[[^\]]*\b(m|rad|s|kg|N|J)\b[^\]]*\]")
    wrong = [e.__name__ for e in TABLE if not unit.search(e.__doc__ or "")]
    assert not wrong, (
        f"say in the docstrings of these classes the units of their numbers, in brackets: {wrong}"
    )


def test_joints_document_their_residual():
    joints = [e for e in TABLE if issubclass(e, nc.Joint) and e is not nc.Screw]
    wrong = [e.__name__ for e in joints if not re.search(r"\[(m|-)", e.residual.__doc__ or "")]
    assert not wrong, f"say in the docstring of their residual its units, as [m] or [-]: {wrong}"


# --- what an effect answers to a motion -------------------------------------------------------------------


@cache
def stage(effect: type, in_tree: bool = False):
    """A pair with an effect: system (not checked: some would be refused as they start), state and group.

    A joint under test keeps its multipliers, so that it may be shown motions that it would not allow; or it
    is `in_tree`, and all motions are free ones.
    """
    entry = TABLE[effect]
    scene = nc.Scene()
    one = nc.RigidBody(mass=2.0, inertia=(0.3, 0.4, 0.5), com=(0.05, -0.03, 0.1), position=(0.0, 0.0, -1.0))
    two = nc.RigidBody(
        mass=1.5, inertia=(0.2, 0.12, 0.25), position=(0.5, 0.3, -1.6), orientation=(AXIS, 0.7), name="two"
    )
    parts = Parts(scene.add(one), scene.add(two), None)
    kind = entry.joint if entry.make or in_tree else with_multipliers(entry.joint)
    options = SPECIAL.get(entry.joint, {})
    parts.joint = scene.add(
        kind(parts.one, parts.two, point=(0.2, 0.1, -1.3), axis=AXIS, second=SECOND, name="joint", **options)
    )
    if entry.make:
        scene.add(entry.make(parts))
    system, state = build(scene.bodies, scene.joints, scene.effects, None)
    group = next(g for g in (*system.effects, *system.joints) if isinstance(g.effect, effect))
    return system, state, group


def inputs_of(system):
    return 0.5 + jnp.arange(len(system.structure.inputs))


@dataclass
class Answers:
    """What an effect answers to random motions, one a lane.

    Attributes:
        forces: on the rows of its bodies (lanes, bodies, 4, 3).
        torques: on its bodies (lanes, bodies, 3).
        answer: all that it answers.
        motion: of its bodies.
        stored: energies before and after the step (lanes, 2).
    """

    forces: Any
    torques: Any
    answer: Any
    motion: Any
    stored: Any


def respond_to(effect: type, in_tree: bool = False):
    """The function from rates of the free motions and multipliers to the answer and the motion."""
    system, state, group = stage(effect, in_tree)
    u, h = inputs_of(system), jnp.ones(())
    step = ReducedStep.prepare(system, state, u, h, TABLEAU)
    where = situation(system, group, state, u, h)

    def answer(w, lam):
        at = step.stations(step.motion(w[None])[0])
        motion = gather(group, at)
        multipliers = jnp.broadcast_to(lam, (group.count, 1, group.multipliers))
        return respond(group, where, motion, multipliers, TABLEAU), motion

    return answer


def random_motion(effect: type, seed: int, in_tree: bool = False):
    """Rates of about one radian and one metre in the step, and random multipliers."""
    system, _, group = stage(effect, in_tree)
    rng = np.random.default_rng(seed)
    w = rng.normal(size=system.structure.unknowns)
    w *= 1.2 / np.linalg.norm(w[:6])
    return w, rng.normal(size=group.multipliers)


def directions_of(effect: type):
    """Where differences are taken, a motion and rest, and a direction."""
    w, lam = random_motion(effect, 3)
    return (w, np.zeros_like(w)), np.random.default_rng(4).normal(size=w.shape), lam


@cache
def answers(effect: type, in_tree: bool) -> Answers:
    """One program for all motions of an effect: those of the seeds, then those of the differences."""
    motions = [random_motion(effect, seed, in_tree) for seed in SEEDS]
    if not in_tree:
        starts, direction, lam = directions_of(effect)
        motions += [(w, lam) for start in starts for w in (start, *lanes_along(start, direction))]
    system, state, _ = stage(effect, in_tree)

    def energies(w):
        if effect not in STORING:
            return jnp.zeros(2)
        if issubclass(effect, CoordinateEffect):  # its coordinates are summed up over the steps
            y = jnp.zeros(system.structure.unknowns + system.structure.multipliers).at[: len(w)].set(w)
            after = advance(system, state, inputs_of(system), jnp.ones(()), y, TABLEAU)[1]
        else:
            step = ReducedStep.prepare(system, state, inputs_of(system), jnp.ones(()), TABLEAU)
            rates = step.stations(step.motion(w[None])[0]).rates[0, :-1].reshape(-1, 3)
            after = replace_fields(state, q=state.q + rates)
        return jnp.stack([system.energy(s).potential for s in (state, after)])

    def of_lane(w, lam):
        return *respond_to(effect, in_tree)(w, lam), energies(w)

    lanes = jax.jit(jax.vmap(of_lane))(*(np.stack(x) for x in zip(*motions, strict=True)))
    response, motion, stored = jax.tree.map(np.asarray, lanes)
    forces = np.zeros_like(motion.rows) if response.forces is None else response.forces
    forces = forces.reshape(*motion.start.shape[:2], -1, 4, 3)[:, 0]
    torques = np.zeros_like(forces[:, :, 0]) if response.torques is None else response.torques[:, 0, 0]
    return Answers(forces, torques, response, motion, stored)


def scale_of(a: Answers, seed: int) -> float:
    return np.sum(np.abs(a.forces[seed])) + np.sum(np.abs(a.torques[seed]))


@pytest.mark.slow
@pytest.mark.parametrize("effect", [e for e in TABLE if e.elastic], ids=lambda e: e.__name__)
def test_elastic_effects_say_what_cancels(effect):
    """At rest their forces are rounded as stiffness times invariants, of which they are differences, are."""
    system, state, group = stage(effect)
    one = jax.tree.map(lambda x: x[0], group.effect)
    place, rows = group_places(system, group)[0], rows_with_ground(state.q)[group.bodies[0]]
    coordinate = state.coordinates[group.coordinates[0]] + 0.3

    def numbers(rows, coordinate):
        scales = one.cancelling(place, rows, coordinate)
        assert scales is not None, "a stiff part of this kind could not be told from an unsolved step"
        by_coordinate = issubclass(effect, CoordinateEffect)
        invariants = coordinate if by_coordinate else one.invariants(place_markers(place, rows))
        return *scales, jnp.diag(one.curvature(place, rows, coordinate)), invariants

    energy, reach, stiffness, invariants = jax.jit(numbers)(rows, coordinate)
    assert energy >= (1 - tol.STIFFNESS_BY_ENERGIES) * np.sum(np.abs(stiffness) * invariants**2) > 0
    assert 0 < reach <= 10, "of the size of the scene"


@EFFECTS
def test_power_is_force_times_velocity(effect):
    """What goes into the work account, or the constraints' multipliers times their rates."""
    a = answers(effect, False)
    for seed in SEEDS:
        power = np.sum(a.forces[seed] * a.motion.rates[seed, 0, 0])
        power += np.sum(a.torques[seed] * a.motion.spin[seed, 0, 0])
        scale = scale_of(a, seed)
        assert scale > 0.01, "the effect does nothing here"
        if effect.rotors:  # what a rotor takes is not lost: it is stored
            continue
        if effect.works or effect.stores:
            assert abs(power - a.answer.power[seed, 0, 0]) <= tol.INDIFFERENCE * scale
        else:
            lam = random_motion(effect, seed)[1]
            assert abs(power - lam @ a.answer.rows[seed, 0, 0]) <= tol.INDIFFERENCE * scale


@pytest.mark.parametrize("effect", [e for e in TABLE if TABLE[e].inside], ids=lambda e: e.__name__)
def test_what_acts_inside_moves_nothing_as_a_whole(effect):
    """No resultant force, no resultant torque about any point."""
    in_tree = issubclass(effect, nc.Joint) and effect.free  # its points must coincide
    a = answers(effect, in_tree)
    for seed in SEEDS:
        rows = a.motion.rows[seed, 0, 0]
        scale = scale_of(a, seed)
        assert np.max(np.abs(a.forces[seed][:, 0].sum(0))) <= tol.INDIFFERENCE * scale
        turning = np.cross(rows, a.forces[seed]).sum((0, 1)) + a.torques[seed].sum(0)
        assert np.max(np.abs(turning)) <= tol.INDIFFERENCE * scale * (1 + np.max(np.abs(rows)))


@pytest.mark.parametrize("effect", STORING, ids=lambda e: e.__name__)
def test_stores_give_what_they_lose(effect):
    """Over a step of one radian: minus the work on the bodies is the change of the stored energy, exactly."""
    a = answers(effect, False)
    for seed in SEEDS:
        if issubclass(effect, nc.Field):  # an instance for every body
            work = np.sum(a.answer.forces[seed][:, 0] * a.motion.rates[seed][0])
        else:
            work = np.sum(a.forces[seed] * a.motion.rates[seed, 0, 0])
            work += np.sum(a.torques[seed] * a.motion.spin[seed, 0, 0])
        before, after = a.stored[seed]
        assert abs(after - before) > 1e-3
        assert abs(after - before + work) <= tol.STEP_BALANCE * (1 + abs(after) + abs(before))


def response_of(effect: type, lam):
    """The function from a motion to the arrays of the answer that depend on it."""

    def f(w):
        response, motion = respond_to(effect)(w, lam)
        return response.forces, response.torques, response.rows, motion.rates

    return f


@pytest.mark.parametrize(
    "effect",
    [pytest.param(e, marks=pytest.mark.exhaustive if e is nc.MortarGap else ()) for e in TABLE],
    ids=[e.__name__ for e in TABLE],
)
def test_derivatives_equal_differences(effect):
    """Of forces, torques and constraint rates with respect to the motion; at rest, too.

    Differences are lanes of a batch, the derivative is of one motion alone: both have the same value.
    """
    (moving, rest), direction, lam = directions_of(effect)
    derivative = jax.jit(lambda w: jax.jvp(response_of(effect, lam), (w,), (direction,)))
    a, count = answers(effect, False), 1 + 2 * len(STEPS)
    lanes = jax.tree.leaves((a.answer.forces, a.answer.torques, a.answer.rows, a.motion.rates))
    for number, w in enumerate((moving, rest)):
        value, ahead = derivative(w)
        first = len(SEEDS) + number * count
        for alone, lane in zip(jax.tree.leaves(value), lanes, strict=True):
            assert np.allclose(alone, lane[first], rtol=1e-12, atol=1e-12)
        errors = errors_of_lanes([x[first + 1 : first + count] for x in lanes], ahead)
        if w is moving:
            assert_v_of_errors(errors)
        else:  # there may be nothing of second order
            assert np.min(errors) <= tol.DIFFERENCE_BEST


@pytest.mark.parametrize(
    "effect",
    [pytest.param(e, marks=pytest.mark.slow if e in REVERSED else pytest.mark.exhaustive) for e in TABLE],
    ids=[e.__name__ for e in TABLE],
)
def test_reverse_derivatives_are_transposed_forward_ones(effect):
    (moving, rest), direction, lam = directions_of(effect)

    @jax.jit
    def products(w):
        _, ahead = jax.jvp(response_of(effect, lam), (w,), (direction,))
        weights = jax.tree.map(jnp.cos, ahead)
        back = jax.vjp(response_of(effect, lam), w)[1](weights)[0] @ direction
        return back, sum(map(jnp.vdot, jax.tree.leaves(weights), jax.tree.leaves(ahead)))

    for w in (moving, rest):
        back, ahead = products(w)
        assert abs(back - ahead) <= tol.SAME_GRADIENT * abs(ahead)


# --- joints -----------------------------------------------------------------------------------------------


RESIDUALS = pytest.mark.parametrize(
    "joint", [e for e in TABLE if issubclass(e, nc.Joint | nc.Constraint)], ids=lambda e: e.__name__
)


@cache
def constraint(joint: type):
    """Compiled residual over the rows (k, 4, 3) of its bodies, and rows that obey it."""
    system, state, group = stage(joint)
    effect, place = jax.tree.map(lambda x: x[0], (group.effect, group_places(system, group)))
    rows = rows_with_ground(state.q)[group.bodies[0]]
    return jax.jit(lambda x: effect.violation(place, x, state.coordinates, state.t)), rows


@JOINT_TYPES
def test_number_of_constraints(joint):
    residual, rows = constraint(joint)
    assert residual(rows).shape == (TABLE[joint].constraints,) == (joint.multipliers,)
    if joint.free:
        motions = len(joint.rotations) + len(joint.translations) + joint.child_rotation
        assert motions == 6 - joint.multipliers


@JOINT_TYPES
def test_residual_vanishes_in_the_assembled_pose(joint):
    residual, rows = constraint(joint)
    assert np.max(np.abs(residual(rows))) <= tol.IDENTITY


@RESIDUALS
def test_residual_is_at_most_quadratic(joint):
    """Third differences vanish along any direction, second ones along some do not."""
    residual, rows = constraint(joint)
    for seed in SEEDS:
        step = jnp.asarray(np.random.default_rng(seed).normal(size=rows.shape))
        g = [residual(rows + k * step) for k in range(4)]
        scale = max(float(jnp.max(jnp.abs(x))) for x in g)
        assert np.max(np.abs(g[3] - 3 * g[2] + 3 * g[1] - g[0])) <= tol.IDENTITY * scale
    linear = joint in (nc.Spherical, nc.PointOnPoint, nc.PointSum)
    assert linear or np.max(np.abs(g[2] - 2 * g[1] + g[0])) > 1e-3


@RESIDUALS
def test_residual_does_not_see_rigid_motions(joint):
    """A common rotation of all rows and a common translation of the points change nothing."""
    residual, rows = constraint(joint)
    rng = np.random.default_rng(5)
    rows = rows + jnp.asarray(0.1 * rng.normal(size=rows.shape))
    turn = from_rotation_vector(jnp.asarray(rng.normal(size=3)))
    moved = (rows @ turn.T).at[:, 0].add(jnp.asarray(rng.normal(size=3)))
    seen, unseen = residual(moved), residual(rows)
    if joint in (
        nc.Fixed,
        nc.Spherical,
        nc.Revolute,
        nc.Universal,
        nc.PointOnPoint,
        nc.PointSum,
    ):  # the gap is a vector of the world
        unseen = unseen.at[:3].set(turn @ unseen[:3])
    assert np.max(np.abs(seen - unseen)) <= tol.INDIFFERENCE


@RESIDUALS
def test_central_differences_of_the_residual_are_exact(joint):
    """For a quadratic a central difference has no truncation at any step."""
    residual, rows = constraint(joint)
    step = jnp.asarray(np.random.default_rng(6).normal(size=rows.shape))
    derivative = jax.jvp(residual, (rows,), (step,))[1]
    assert_v_shaped(residual, rows, step, derivative, polynomial=True)
    whole = 0.5 * (residual(rows + step) - residual(rows - step))
    assert np.max(np.abs(whole - derivative)) <= tol.INDIFFERENCE


@pytest.mark.parametrize("joint", [j for j in JOINTS.values() if j.free], ids=lambda j: j.__name__)
def test_free_motions_do_not_see_the_constraints(joint):
    """max |G(q_mid) P| at random steps of one radian, and g = 0 at their ends, step after step."""
    system, state, group = stage(joint, in_tree=True)
    assert group.in_tree
    effect, place = jax.tree.map(lambda x: x[0], group.effect), system.frames[group.joints[0, 0]]

    def residual(rows):
        return effect.residual(*frames_at(place, rows))

    @jax.jit
    def look(state, w):
        step = ReducedStep.prepare(system, state, inputs_of(system), jnp.ones(()), TABLEAU)

        def mean(w):
            motion = gather(group, step.stations(step.motion(w[None])[0]))
            return motion.rows[0, 0], motion.rates[0, 0]

        rows, rates = mean(w)
        g_rate = jax.jvp(residual, (rows,), (rates,))[1]
        everything = step.stations(step.motion(w[None])[0]).rates[0, :-1].reshape(-1, 3)
        return g_rate, residual(rows + 0.5 * rates), replace_fields(state, q=state.q + everything)

    rng = np.random.default_rng(7)
    for _ in range(5):
        w = rng.normal(size=system.structure.unknowns)
        w[3:6] *= 0.2  # drift of the first body
        w *= 1.0 / np.linalg.norm(w[:3])
        g_rate, g, state = look(state, jnp.asarray(w))
        size = 1.0 + np.max(np.abs(w))
        assert np.max(np.abs(g_rate), initial=0.0) <= tol.IDENTITY * size**2
        assert np.max(np.abs(g), initial=0.0) <= tol.IDENTITY * size**2


# --- potentials -------------------------------------------------------------------------------------------

POTENTIALS = [e for e in TABLE if issubclass(e, nc.Potential)]
EVERY_POTENTIAL = pytest.mark.parametrize("potential", POTENTIALS, ids=lambda e: e.__name__)


@cache
def potential_of(effect: type):
    """Compiled invariants and energy over the marker vectors, and their values at the start."""
    _, state, group = stage(effect)
    law = jax.tree.map(lambda x: x[0], group.effect)
    rows = state.q.reshape(-1, 4, 3)[group.bodies[0]]
    x = place_markers(group.weights[0], rows)
    points = group.weights[0][..., 0] > 0
    return jax.jit(lambda x: law.invariants(x)), jax.jit(lambda x: law.energy(law.invariants(x))), x, points


@EVERY_POTENTIAL
def test_invariants_are_invariant_and_at_most_quadratic(potential):
    invariants, energy, x, points = potential_of(potential)
    rng = np.random.default_rng(8)
    turn = from_rotation_vector(jnp.asarray(rng.normal(size=3)))
    moved = x @ turn.T + jnp.where(points[..., None], jnp.asarray(rng.normal(size=3)), 0.0)
    assert np.allclose(invariants(moved), invariants(x), rtol=tol.INDIFFERENCE)
    assert np.allclose(energy(moved), energy(x), rtol=tol.INDIFFERENCE)
    step = jnp.asarray(rng.normal(size=x.shape))
    p = [invariants(x + k * step) for k in range(4)]
    assert np.max(np.abs(p[3] - 3 * p[2] + 3 * p[1] - p[0])) <= tol.IDENTITY * np.max(np.abs(p[3]))


@EVERY_POTENTIAL
def test_gradient_of_the_energy(potential):
    _, energy, x, _ = potential_of(potential)
    rng = np.random.default_rng(9)
    step = jnp.asarray(rng.normal(size=x.shape))
    # As assembled some are free of stress, and their energy has no slope.
    x = x + 0.1 * jnp.asarray(rng.normal(size=x.shape))
    assert_v_shaped(energy, x, step, jnp.vdot(jax.grad(energy)(x), step))
