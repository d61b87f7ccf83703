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
from differences import assert_v_of_errors
from scenes import AXIS, JOINTS, SECOND, SPECIAL, with_multipliers

import natcoord_jax as nc
import natcoord_jax.effects

Effect = nc.Force.__mro__[1]
pytestmark = pytest.mark.users


def turned(vector):
    """Matrix of a turn by a rotation vector."""
    angle = np.linalg.norm(vector)
    x, y, z = np.asarray(vector) / angle
    skew = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


CORNERS = np.vstack([np.zeros(3), np.eye(3)])
MIDDLES = [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]


@cache
def cell_nodes(count):
    """Nodes of a cell: hexahedra from -1 to 1, and a tetrahedron with the nodes of its edges."""
    if count == 10:
        return np.vstack([CORNERS, [CORNERS[list(pair)].mean(axis=0) for pair in MIDDLES]])
    mesh = nc.mesh.box((2.0, 2.0, 2.0), (1, 1, 1), element=f"hexahedron{count}")
    return np.asarray(mesh.nodes)[mesh.cells[0]] - 1.0


FACES = {6: (0, 1, 2, 4, 5, 6), 8: (0, 1, 5, 4, 8, 17, 12, 16), 9: (0, 1, 5, 4, 8, 17, 12, 16, 22)}
"""Nodes of a face of a tetrahedron, and of hexahedra of 20 and 27 nodes."""


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
        first = nc.Attachment(self.one, (0.1, 0.0, -1.2), turned((0.3, -0.2, 0.5)))
        return first, nc.Attachment(self.two, (0.4, 0.4, -1.9), turned((0.1, 0.4, 0.2)))

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
        nodes = cell_nodes(count)
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
        lambda p: nc.FacePressure6([p.cell(10)[k] for k in FACES[6]], pressure=jnp.sin),
        inside=False,
    ),
    nc.FacePressure8: Entry(
        lambda p: nc.FacePressure8([p.cell(20)[k] for k in FACES[8]], pressure=jnp.sin),
        inside=False,
    ),
    nc.FacePressure9: Entry(
        lambda p: nc.FacePressure9([p.cell(27)[k] for k in FACES[9]], pressure=jnp.sin),
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
def contract(effect: type, in_tree: bool = False):
    """What `nc.testing.check_effect` sees of an effect in a pair; of what is asked only.

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
    parts.joint = part = scene.add(
        kind(parts.one, parts.two, point=(0.2, 0.1, -1.3), axis=AXIS, second=SECOND, name="joint", **options)
    )
    if entry.make:
        part = scene.add(entry.make(parts))
    return nc.testing.check_effect(scene, part, throw=False)


@pytest.mark.slow
@pytest.mark.parametrize("effect", [e for e in TABLE if e.elastic], ids=lambda e: e.__name__)
def test_elastic_effects_say_what_cancels(effect):
    """At rest their forces are rounded as stiffness times invariants, of which they are differences, are."""
    share, reach = contract(effect).cancels
    assert share >= 1 - tol.STIFFNESS_BY_ENERGIES, "a stiff part could not be told from an unsolved step"
    assert 0 < reach <= 10, "of the size of the scene"


@EFFECTS
def test_power_is_force_times_velocity(effect):
    """What goes into the work account, or the constraints' multipliers times their rates."""
    assert contract(effect).size > 0.01, "the effect does nothing here"
    assert contract(effect).power <= tol.INDIFFERENCE


@pytest.mark.parametrize("effect", [e for e in TABLE if TABLE[e].inside], ids=lambda e: e.__name__)
def test_what_acts_inside_moves_nothing_as_a_whole(effect):
    """No resultant force, no resultant torque about any point."""
    in_tree = issubclass(effect, nc.Joint) and effect.free  # its points must coincide
    assert contract(effect, in_tree).push <= tol.INDIFFERENCE
    assert contract(effect, in_tree).turn <= tol.INDIFFERENCE


@pytest.mark.parametrize("effect", STORING, ids=lambda e: e.__name__)
def test_stores_give_what_they_lose(effect):
    """Over a step of one radian: minus the work on the bodies is the change of the stored energy, exactly."""
    assert contract(effect).exchanged > 1e-3
    assert contract(effect).balance <= tol.STEP_BALANCE


@pytest.mark.parametrize(
    "effect",
    [pytest.param(e, marks=pytest.mark.exhaustive if e is nc.MortarGap else ()) for e in TABLE],
    ids=[e.__name__ for e in TABLE],
)
def test_derivatives_equal_differences(effect):
    """Of forces, torques and constraint rates with respect to the motion; at rest, too."""
    moving, rest = contract(effect).differences
    assert_v_of_errors(moving)
    assert np.min(rest) <= tol.DIFFERENCE_BEST  # there may be nothing of second order


@pytest.mark.parametrize(
    "effect",
    [pytest.param(e, marks=pytest.mark.slow if e in REVERSED else pytest.mark.exhaustive) for e in TABLE],
    ids=[e.__name__ for e in TABLE],
)
def test_reverse_derivatives_are_transposed_forward_ones(effect):
    assert contract(effect).reverse <= tol.SAME_GRADIENT


WRITTEN = {
    nc.JointTorque, nc.JointForce, nc.AffineActuator, nc.WrenchInput, nc.JointSpring, nc.JointStops,
    nc.Armature, nc.JointFriction, nc.Coupling, nc.PointOnPoint,
}  # fmt: skip
"""Effects that MJCF has."""


@pytest.mark.slow
@pytest.mark.parametrize("effect", [e for e in TABLE if TABLE[e].make], ids=lambda e: e.__name__)
def test_every_effect_is_saved_as_mjcf_or_noted(effect):
    mujoco = pytest.importorskip("mujoco")
    look = contract(effect)
    saved = nc.io.save_mjcf(look.system, look.state)
    mujoco.MjModel.from_xml_string(saved.text)
    noted = look.name in {note.part for note in saved.notes}
    assert noted != (effect in WRITTEN or effect is nc.Gravity)


# --- joints and potentials --------------------------------------------------------------------------------


@JOINT_TYPES
def test_number_of_constraints(joint):
    assert TABLE[joint].constraints == joint.multipliers
    if joint.free:
        motions = len(joint.rotations) + len(joint.translations) + joint.child_rotation
        assert motions == 6 - joint.multipliers


@JOINT_TYPES
def test_residual_vanishes_in_the_assembled_pose(joint):
    look = contract(joint)
    assert np.max(look.system.constraint_errors(look.state).position) <= tol.IDENTITY


SHAPED = pytest.mark.parametrize(
    "effect",
    [e for e in TABLE if issubclass(e, nc.Joint | nc.Constraint | nc.Potential)],
    ids=lambda e: e.__name__,
)


@SHAPED
def test_residuals_and_invariants_are_at_most_quadratic(effect):
    """Third differences vanish along any direction."""
    assert contract(effect).degree <= tol.IDENTITY


@pytest.mark.parametrize("joint", [j for j in JOINTS.values() if j.free], ids=lambda j: j.__name__)
def test_free_motions_do_not_see_the_constraints(joint):
    """max |G(q_mid) P| at random steps of one radian, and g = 0 at their ends, step after step."""
    assert contract(joint, in_tree=True).free <= tol.IDENTITY


@SHAPED
def test_residuals_and_energies_do_not_see_rigid_motions(effect):
    assert contract(effect).invariance <= tol.INDIFFERENCE


# --- effects of one's own ---------------------------------------------------------------------------------


class Pull(nc.Potential):
    """A spring that knows the first axis of the world."""

    def invariants(self, x):
        return (x[1] - x[0])[:1]

    def energy(self, invariants):
        return 5.0 * invariants[0] ** 2


class Push(nc.Force):
    """On the second of its points alone."""

    def load(self, x, rate, inputs, t):
        return nc.Load(jnp.stack([jnp.zeros(3), 3.0 * (x[0] - x[1])]), None)


class Cut(Push):
    """A law whose slope JAX is told wrongly: nothing comes through."""

    def load(self, x, rate, inputs, t):
        stretch = jax.lax.stop_gradient(x[1] - x[0])
        return nc.Load(jnp.stack([3.0 * stretch, -3.0 * stretch]), None)


MISSED = [
    (Pull, "Pull 'own' is another when .*; it turns the whole"),
    (Push, "pushes the whole"),
    (Cut, "has derivatives that are none of its values"),
]


@pytest.mark.slow
@pytest.mark.parametrize("kind, words", MISSED, ids=[kind.__name__ for kind, _ in MISSED])
def test_what_an_effect_of_ones_own_does_not_keep_is_named(kind, words):
    scene = nc.Scene()
    bodies = [nc.RigidBody(mass=1.0, inertia=(1, 2, 2), position=(x, 0.1, x)) for x in (0.0, 1.0)]
    ends = tuple(nc.Point(scene.add(body), (0.3, 0.2, 0.1), local=True) for body in bodies)
    own = scene.add(kind(ends, name="own"))
    with pytest.raises(AssertionError, match=words):
        nc.testing.check_effect(scene, own, inside=True)
    with pytest.raises(ValueError, match="no effect 'other'; pass one of.*'own'"):
        nc.testing.check_effect(scene, "other")
