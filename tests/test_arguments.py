"""Every public call with something else than it takes: an error of our own that names the argument.

The table gives for every argument what it takes, by examples. Everything of another sort is fed to it: text,
a number, nothing, a body, a joint, an object. A new public name, or argument, needs its line.
"""

import dataclasses
import inspect
import re
import traceback
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import natcoord_jax as nc
from natcoord_jax.control.guess import scattered
from natcoord_jax.control.iterate import Options
from natcoord_jax.control.solution import Solution
from natcoord_jax.control.transcription import Unknowns
from natcoord_jax.core.handles import Handle
from natcoord_jax.system import System


@cache
def world():
    """A compiled scene, and one of each thing that can be passed."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), com=(0.3, 0.0, 0.0), name="body"))
    hinge = scene.add(nc.Revolute(nc.ground, body, axis=(0.0, 1.0, 0.0), name="hinge"))
    motor = scene.add(nc.JointTorque(hinge, name="motor"))
    section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=2.0, GJ=1.0, density=1.0, rotary=0.1)
    system, state = scene.compile()
    other = nc.Scene()
    beam = other.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=2, start=nc.ground, name="beam"))
    trajectory = nc.simulate(system, state, dt=0.1, steps=2)
    problem = nc.OptimalControl(system, state, dt=0.1, steps=2, cost=nc.cost.Effort())
    point, direction = nc.Point(body, (1.0, 0.0, 0.0)), nc.Direction(body, (1.0, 0.0, 0.0))
    unknowns = Unknowns(jnp.zeros((2, 1)), jnp.zeros(0), jnp.zeros((2, 1)))
    solution = Solution(problem, jnp.zeros((2, 1)), {}, 0.1, 0.0, 0, "none", None, None, [])
    return SimpleNamespace(
        scene=scene, body=body, hinge=hinge, motor=motor, section=section, system=system, state=state,
        beam=beam, trajectory=trajectory, problem=problem, unknowns=unknowns, solution=solution, point=point,
        direction=direction, triad=tuple(nc.Direction(body, axis) for axis in np.eye(3)),
        ends=(nc.Point(nc.ground), point), nodes=nc.Scene().add(nc.Nodes.points(np.ones((4, 3)), mass=1.0)),
        shell=nc.Scene().add(
            nc.Shell(nc.mesh.rectangle((1, 1), (1, 1)), thickness=0.1, material=nc.Elastic(E=1, density=1))
        ),
        attached=tuple(nc.Attachment(b, (0, 0, 0), np.eye(3)) for b in (nc.ground, body)),
    )  # fmt: skip


def f(*_):
    """A function."""
    return 0.0


V, NAME, NUMBER, WHOLE, FLAG = [np.ones(3)], ["name"], [1.0], [1], [True]
PLACES = [np.ones((4, 3))]
JOINT = lambda w: {  # noqa: E731
    "parent": [nc.ground], "child": [w.body], "point": V, "axis": V, "second": [np.array([0, 1, -1.0])],
    "name": NAME,
}  # fmt: skip
ON_JOINT = lambda w: {"joint": [w.hinge], "coordinate": [0], "name": NAME}  # noqa: E731
MARKED = lambda markers: {"markers": [markers], "name": NAME}  # noqa: E731
RUN = lambda w: {"system": [w.system], "state": [w.state]}  # noqa: E731
GAP = lambda markers: {  # noqa: E731
    **MARKED(markers), "stiffness": NUMBER, "law": ["linear", "hertz"], "restitution": NUMBER,
    "speed": NUMBER,
}  # fmt: skip
GAS = dict.fromkeys(("gauge_pressure", "ambient", "exponent", "volume"), [1.0])
PAIRED = [np.ones((2, 4, 2, 4))]
MASS = ["lumped", "consistent"]
METAL, SQUARE = [nc.Elastic(E=1.0)], np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.0)])
LAYER = {
    "thickness": [1.0], "material": METAL, "direction": [np.array((1.0, 0, 0))], "offset": [1.0],
    "prestress": [np.ones(3)], "damping": [1.0], "mass": MASS,
}  # fmt: skip
MEMBRANE = ["hybrid", "hybrid mitc4+"]
RUBBER = [nc.NeoHooke(E=1.0, nu=0.4)]
PLACED = {
    "material": METAL, "position": V, "orientation": [np.eye(3)], "velocity": V, "angular_velocity": V,
    "name": NAME,
}  # fmt: skip
MATRIX, SHAPES = (
    [np.eye(6)],
    {"values": [np.ones((2, 3))], "slopes": [np.ones((2, 3))], "weights": [np.ones(2)]},
)
SECTION = {"E": NUMBER, "nu": [0.3], "density": NUMBER, "shear": NUMBER}
STEPPED = {
    "dt": [0.1],
    "steps": WHOLE,
    "inputs": [np.ones((1, 1)), f],
    "save_every": WHOLE,
    "scheme": [nc.EnergyMomentum()],
}
SOLVED = {"max_iterations": WHOLE, "tol": NUMBER, "goal_tol": NUMBER, "method": ["auto"]}

CALLS = {
    # programs
    "jit": lambda w: {
        "function": [f], "effort": [None, "quick"],
        "static_argnums": [(), 0, (0,)], "static_argnames": [(), "t"],
        "donate_argnums": [(), 0, (0,)], "donate_argnames": [(), "t"],
    },
    "set_effort": lambda w: {"effort": ["quick"]},
    "native_threads": lambda w: {"number": [0]},
    "keep_programs": lambda w: {"folder": [None, "folder"], "on": [True]},
    # bodies
    "RigidBody": lambda w: {
        "mass": NUMBER, "inertia": V, "second_moment": [None, np.ones(3)], "com": V, "inertia_at": ["com"],
        "shape": [None, nc.Box((1, 1, 1))], "density": [None, 1.0], "position": V, "orientation": [np.eye(3)],
        "velocity": V, "angular_velocity": V, "name": NAME,
    },
    "PointMass": lambda w: {"mass": NUMBER, "position": V, "velocity": V, "name": NAME},
    "Box": lambda w: {"size": V},
    "Cylinder": lambda w: {"radius": NUMBER, "length": NUMBER},
    "Sphere": lambda w: {"radius": NUMBER},
    "Ellipsoid": lambda w: {"semi_axes": V},
    "CircularSection": lambda w: {"radius": NUMBER, **SECTION},
    "TubularSection": lambda w: {"radius": NUMBER, "thickness": [0.1], **SECTION},
    "RectangularSection": lambda w: {"width": NUMBER, "height": NUMBER, **SECTION},
    "Section": lambda w: {"stiffness": MATRIX, "inertia": [np.eye(3)], "outline": [np.ones((4, 2))]},
    "Section.of_numbers": lambda w: {
        "EA": NUMBER, "GA": NUMBER, "EI": NUMBER, "GJ": NUMBER, "density": NUMBER, "rotary": NUMBER,
        "centre": [np.zeros(2)], "outline": [np.ones((4, 2))],
    },
    "Section.of_axis_along_first": lambda w: {
        "stiffness": MATRIX, "inertia": [np.eye(3)], "outline": [np.ones((4, 2))]
    },
    "Beam": lambda w: {
        "section": [w.section], "curve": [np.eye(3), f], "elements": WHOLE, "length": NUMBER, "second": V,
        "twist": [0.1, f], "start": [w.body], "end": [w.body], "stations": [(0.5,)],
        "damping": NUMBER, "law": [f], "mass": MASS,
        "interpolation": [nc.RelativeMotion()], "velocity": V, "angular_velocity": V, "name": NAME,
    },
    "LineLoad": lambda w: {
        "beam": [w.beam], "force": [np.ones(3), f], "moment": [np.ones(3), f], "profile": [f],
        "following": FLAG,
        "name": NAME,
    },
    "DirectorInterpolation": lambda w: {"order": WHOLE},
    "RelativeMotion": lambda w: {},
    # markers and joints
    "Point": lambda w: {"body": [w.body], "position": V, "local": FLAG},
    "Direction": lambda w: {"body": [w.body], "vector": V, "local": FLAG},
    "Attachment": lambda w: {"body": [w.body], "point": V, "axes": [np.eye(3)], "local": FLAG},
    **dict.fromkeys(("Fixed", "Spherical", "Universal", "Cylindrical", "Planar"), JOINT),
    **dict.fromkeys(("Revolute", "Prismatic"), lambda w: {**JOINT(w), "zero": NUMBER}),
    "Screw": lambda w: {**JOINT(w), "pitch": NUMBER},
    "Distance": lambda w: {**JOINT(w), "parent_point": V, "length": NUMBER},
    "Drive": lambda w: {**ON_JOINT(w), "function": [f]},
    "Coupling": lambda w: {
        "joint": [(w.hinge,)], "coordinate": [(0,), 0], "name": NAME, "factors": [(1.0,)], "offset": NUMBER
    },
    # effects
    "Gravity": lambda w: {"vector": V, "name": NAME},
    "PointForce": lambda w: {**MARKED((w.point,)), "force": [np.ones(3), f], "following": [False]},
    "BodyTorque": lambda w: {**MARKED((w.direction,)), "torque": [np.ones(3), f], "following": [False]},
    "PairTorque": lambda w: {**MARKED(w.triad[:2]), "torque": [1.0, f]},
    "ShellElement": lambda w: {
        **MARKED(w.attached * 2), **LAYER, "reference": [np.ones((4, 2, 3))], "membrane": MEMBRANE
    },
    "MembraneElement": lambda w: {
        **MARKED(w.ends * 2), **LAYER, "reference": [np.ones((4, 3))], "membrane": MEMBRANE
    },
    "ShellTriangle": lambda w: {
        **MARKED((w.attached * 2)[:3]), **LAYER, "reference": [np.ones((3, 2, 3))]
    },
    "MembraneTriangle": lambda w: {**MARKED((w.ends * 2)[:3]), **LAYER, "reference": [np.ones((3, 3))]},
    "Orthotropic": lambda w: {
        **dict.fromkeys(("E1", "E2", "G12", "G13", "G23", "density"), [1.0]), "nu12": [0.3]
    },
    "Laminate": lambda w: {"material": METAL, "angles": [(0.0, 1.0)], "fractions": [(0.4, 0.6)]},
    "Fold": lambda w: {
        "one": [w.nodes], "other": [w.nodes], "velocity": V, "angular_velocity": V, "name": NAME
    },
    "Brick": lambda w: {
        **MARKED(w.ends * 4), "material": METAL, "mass": MASS, "reference": [np.ones((8, 3))]
    },
    **{
        name: lambda w, count=count: {
            **MARKED((w.ends * 14)[:count]), "material": METAL,
            "reference": [np.ones((count, 3))], "mass": MASS,
        }
        for name, count in (
            ("Hexahedron8", 8), ("Hexahedron20", 20), ("Hexahedron27", 27), ("Tetrahedron10", 10),
        )
    },
    **{
        name: lambda w, count=count: {
            **MARKED((w.ends * 14)[:count]), "material": RUBBER, "reference": [np.ones((count, 3))],
            "mass": MASS,
        }
        for name, count in (("Hexahedron27P1", 27), ("Tetrahedron10P0", 10))
    },
    "NeoHooke": lambda w: {"E": NUMBER, "nu": [0.3], "density": NUMBER},
    "MooneyRivlin": lambda w: {"c10": NUMBER, "c01": NUMBER, "bulk_modulus": NUMBER, "density": NUMBER},
    "CompressibleMooneyRivlin": lambda w: {
        "c10": NUMBER, "c01": NUMBER, "volume_stiffness": NUMBER, "density": NUMBER,
    },
    "Ogden": lambda w: {
        "moduli": [np.ones(2)], "exponents": [np.ones(2)], "bulk_modulus": NUMBER, "density": NUMBER,
    },
    "TransverselyIsotropic": lambda w: {
        "E": NUMBER, "nu": [0.3], "fibre_stiffness": NUMBER, "direction": V, "density": NUMBER,
    },
    "Elastic": lambda w: {"E": NUMBER, "nu": [0.3], "density": NUMBER},
    "Shell": lambda w: {
        "mesh": [nc.mesh.rectangle((1.0, 1.0), (1, 1))], "directors": PLACES, **PLACED, **LAYER,
        "bending": FLAG, "membrane": MEMBRANE,
    },
    "Capsule": lambda w: {"radius": NUMBER, "length": NUMBER},
    "Plane": lambda w: {"normal": V, "point": V, "body": [w.body]},
    "Contact": lambda w: {
        "one": [w.body], "other": [nc.Plane(), w.body], "stiffness": NUMBER, "restitution": NUMBER,
        "friction": NUMBER, "speed": NUMBER, "law": ["linear", "hertz"], "name": NAME, "one_pass": FLAG,
        "candidates": WHOLE, "method": ["nodes", "mortar"], "self_contact": FLAG, "rounding": NUMBER,
        "capacity": WHOLE, "skin": NUMBER, "all_pairs_of": [(w.body,)], "ignore": [[(w.body, w.body)]],
    },
    "GapPotential": lambda w: {
        **MARKED(w.ends), "gap": [nc.SphereOnSphere(radii=(1.0, 1.0))], "stiffness": NUMBER,
        "restitution": NUMBER, "speed": NUMBER, "law": ["linear", "hertz"],
    },
    "GapConstraint": lambda w: {
        **MARKED(w.ends), "gap": [nc.SphereOnSphere(radii=(1.0, 1.0))], "restitution": NUMBER,
        "friction": NUMBER, "regularisation": NUMBER, "compliance": NUMBER,
    },
    "CapsuleContacts": lambda w: {
        **MARKED(w.ends), "radii": [(1.0, 1.0)], "ignored": [np.array([[0, 1]])], "capacity": WHOLE,
        "skin": NUMBER, "stiffness": NUMBER, "restitution": NUMBER, "speed": NUMBER,
        "law": ["linear", "hertz"],
    },
    "FrictionalGapPotential": lambda w: {
        **MARKED(w.ends), "gap": [nc.SphereOnSphere(radii=(1.0, 1.0))], "stiffness": NUMBER,
        "restitution": NUMBER, "speed": NUMBER, "law": ["linear", "hertz"], "friction": NUMBER,
        "regularisation": NUMBER,
    },
    "FrictionalNodeOnFacets": lambda w: {
        **GAP((*w.ends * 2, w.ends[0])), "facets": [((1, 2, 3, 4),)], "open": [1.0], "beyond": [1.0],
        "patch": [(0.0,)], "depth": [1.0, (1.0,)], "thickness": NUMBER, "two_sided": [0.0, 1.0],
        "friction": NUMBER, "regularisation": NUMBER,
    },
    "SphereOnPlane": lambda w: {"radius": NUMBER},
    "DiscOnPlane": lambda w: {"radius": NUMBER},
    "SphereOnSphere": lambda w: {"radii": [(1.0, 1.0)]},
    "CapsuleOnCapsule": lambda w: {"radii": [(1.0, 1.0)]},
    "EllipsoidOnPlane": lambda w: {"semi_axes": V},
    "SphereOnBox": lambda w: {"size": V, "radius": NUMBER},
    "CornersOnBox": lambda w: {"size": V, "corner": V, "rounding": NUMBER},
    "EdgesOnEdges": lambda w: {"sizes": [np.ones((2, 3))], "skew": [(1.0, -1.0)], "rounding": NUMBER},
    "MortarGap": lambda w: {
        **GAP(w.ends * 4), "facets": [((0, 1, 2, 3),)], "others": [((4, 5, 6, 7),)], "rims": [0.0, (1.0,)],
        "open": [0.0, 1.0], "thickness": NUMBER,
    },
    "NodeOnFacets": lambda w: {
        **GAP((*w.ends * 2, w.ends[0])),
        "facets": [((1, 2, 3, 4),)],
        "open": [1.0],
        "beyond": [1.0],
        "patch": [(0.0,)],
        "depth": [1.0, (1.0,)],
        "thickness": NUMBER,
        "two_sided": [0.0, 1.0],
    },
    "FacePressure": lambda w: {**MARKED(w.ends * 2), "pressure": [1.0, f]},
    "FacePressure6": lambda w: {**MARKED(w.ends * 3), "pressure": [1.0, f]},
    "FacePressure8": lambda w: {**MARKED(w.ends * 4), "pressure": [1.0, f]},
    "FacePressure9": lambda w: {**MARKED((w.ends * 5)[:9]), "pressure": [1.0, f]},
    "EdgeSegment": lambda w: {
        **MARKED(w.attached), "force": [np.ones(3), f], "moment": [np.ones(3), f], "following": FLAG,
        "length": NUMBER,
    },
    "EdgeLoad": lambda w: {
        "edge": [w.shell.edge("right")], "force": [np.ones(3), f], "moment": [np.ones(3), f],
        "following": FLAG, "name": NAME,
    },
    "Pressure": lambda w: {"surface": [w.shell], "pressure": [1.0, f], "name": NAME},
    "EnclosedGas": lambda w: {**MARKED(w.ends * 2), "faces": [np.array([[0, 1, 2, 3]])], **GAS},
    "Gas": lambda w: {"surface": [w.shell, (w.shell,)], "name": NAME, **GAS},
    "PointSum": lambda w: {**MARKED(w.ends), "weights": [(1.0, -1.0)]},
    "Tie": lambda w: {"one": [w.shell.face()], "other": [w.shell.face()], "name": NAME},
    "Scene.move_nodes": lambda w: {"nodes": [w.nodes], "positions": PLACES},
    "Solid": lambda w: {
        "mesh": [nc.mesh.box((1.0, 1.0, 1.0), (1, 1, 1))], "element": [None, "Hexahedron8"], "mass": MASS,
        **PLACED,
    },
    "mesh.rectangle": lambda w: {"size": [(1.0, 1.0)], "counts": [(2, 2)]},
    "mesh.box": lambda w: {"size": V, "counts": [(2, 2, 2)], "element": ["hexahedron8"]},
    "mesh.cylinder": lambda w: {"radius": NUMBER, "length": NUMBER, "counts": [(4, 2)]},
    "mesh.sphere": lambda w: {"radius": NUMBER, "count": WHOLE},
    "mesh.cleaned": lambda w: {
        "nodes": [SQUARE], "cells": [np.array([[0, 1, 2, 3]])], "sets": [{}], "faces": [{}]
    },
    "Clamp": lambda w: {"body": [nc.ground], "nodes": [w.nodes], "name": NAME},
    "Nodes.points": lambda w: {"positions": PLACES, "mass": NUMBER, "velocity": V, "name": NAME},
    "Nodes.directors": lambda w: {
        "positions": PLACES, "directors": V, "mass": NUMBER, "inertia": NUMBER, "velocity": V,
        "angular_velocity": V, "name": NAME,
    },
    "Nodes.triads": lambda w: {
        "positions": PLACES, "orientations": [np.eye(3)], "mass_blocks": [np.eye(4)], "velocity": V,
        "angular_velocity": V, "name": NAME,
    },
    "PointOnPlane": lambda w: {**MARKED((w.ends[0], w.direction, w.point)), "distance": NUMBER},
    "PointOnLine": lambda w: MARKED((w.ends[0], w.direction, w.point)),
    "PointOnPoint": lambda w: MARKED(w.ends),
    "Rod": lambda w: {**MARKED(w.ends), "length": NUMBER},
    "Rolling": lambda w: {**MARKED((w.ends[0], w.direction, w.point)), "radius": NUMBER},
    "Spring": lambda w: {**MARKED(w.ends), "stiffness": NUMBER, "length": NUMBER},
    "QuadraticSpring": lambda w: {**MARKED(w.ends), "stiffness": NUMBER, "length": NUMBER},
    "NonlinearSpring": lambda w: {**MARKED(w.ends), "law": [f]},
    "Damper": lambda w: {**MARKED(w.ends), "damping": NUMBER},
    "JointSpring": lambda w: {**ON_JOINT(w), "stiffness": NUMBER, "rest": NUMBER},
    "JointPotential": lambda w: {**ON_JOINT(w), "law": [f]},
    "JointStops": lambda w: {**ON_JOINT(w), "stiffness": NUMBER, "lower": [-1.0], "upper": NUMBER},
    "JointDamper": lambda w: {**ON_JOINT(w), "damping": NUMBER},
    "JointFriction": lambda w: {**ON_JOINT(w), "friction": NUMBER, "slip": NUMBER},
    "SphericalSpring": lambda w: {**MARKED(w.attached), "stiffness": NUMBER},
    "SphericalDamper": lambda w: {**MARKED(w.triad[:2]), "damping": NUMBER},
    "Armature": lambda w: {**ON_JOINT(w), "inertia": NUMBER},
    "JointTorque": lambda w: {"joint": [w.hinge], "gear": NUMBER, "axis": [2], "name": NAME},
    "JointForce": lambda w: {**ON_JOINT(w), "gear": NUMBER},
    "AffineActuator": lambda w: {
        "joint": [(w.hinge,)], "coordinate": [(0,), 0], "name": NAME, "gear": [(1.0,)], "gain": V, "bias": V,
        "lower": [-1.0], "upper": NUMBER, "least": [-1.0], "most": NUMBER,
    },
    "WrenchInput": lambda w: {
        **MARKED((w.point, *w.triad)), "force": V, "torque": V, "lower": [-1.0], "upper": NUMBER
    },
    "SphericalTorque": lambda w: {
        **MARKED(w.triad[:2]), "gear": NUMBER, "lower": [-1.0], "upper": NUMBER
    },
    "BodyTorqueInput": lambda w: MARKED(w.triad),
    "BodyForceInput": lambda w: MARKED((w.point, w.direction)),
    "BeamElement": lambda w: {
        **MARKED(w.attached), "length": NUMBER, "stiffness": MATRIX, "reference": [np.ones(6)],
        "inertia": PAIRED,
    },
    "NonlinearBeamElement": lambda w: {
        **MARKED(w.attached), "length": NUMBER, "stiffness": MATRIX, "reference": [np.ones(6)], "law": [f],
        "inertia": PAIRED,
    },
    "BeamDamping": lambda w: {**MARKED(w.attached), "length": NUMBER, "viscosity": MATRIX},
    "DirectorElement": lambda w: {
        **MARKED(w.attached), **SHAPES, "stiffness": MATRIX, "reference": [np.ones((2, 6))],
        "inertia": PAIRED,
    },
    "DirectorDamping": lambda w: {**MARKED(w.attached), **SHAPES, "viscosity": MATRIX},
    # runs and analysis
    "Scene": lambda w: {},
    "Scene.add": lambda w: {
        "part": [nc.PointMass(mass=1.0)], "name": [None], "position": [None], "orientation": [None]
    },
    "Scene.add_mass": lambda w: {"handle": [w.body], "block": [np.zeros((4, 4))]},
    "Scene.joined": lambda w: {"one": [w.body], "other": [w.body]},
    "Scene.find": lambda w: {"handle": [w.body, w.hinge], "user": NAME},
    "Scene.compile": lambda w: {"assemble": FLAG, "solver": ["reduced"], "t": NUMBER},
    "simulate": lambda w: {
        **RUN(w), **STEPPED, "throw": FLAG, "until": [f], "checkpoint": FLAG, "newton_tol": NUMBER,
        "extra_substeps": WHOLE, "rtol": NUMBER, "atol": NUMBER, "progress": FLAG, "store": [None, "file"],
        "resume": FLAG,
    },
    "save": lambda w: {"path": ["file"], "x": one_of_each_sort()},
    "load": lambda w: {"path": ["file"]},
    "sweep": lambda w: {
        "function": [f], "axes": [{"x": V[0]}], "store": [None, "folder"], "executor": one_of_each_sort(),
        "block": [None, 1], "buckets": [(), []], "progress": FLAG,
    },
    "step": lambda w: {
        **RUN(w), "u": [np.ones(1)], "dt": [0.1], "newton_tol": NUMBER, "scheme": [nc.EnergyMomentum()]
    },
    "linearise": lambda w: {**RUN(w), "u": [np.ones(1)], "dt": [0.1]},
    "assemble": RUN,
    "transfer": lambda w: {**RUN(w), "into": [w.system], "onto": [w.state]},
    "random_state": lambda w: {**RUN(w), "key": [jax.random.key(0)], "coordinates": NUMBER, "rates": NUMBER},
    "EnergyMomentum": lambda w: {"order": [2], "kick": FLAG, "max_events": WHOLE},
    "Dissipative": lambda w: {"spectral_radius": NUMBER},
    "VariationalMidpoint": lambda w: {},
    "Phases": lambda w: {"systems": [(w.system,)], "trajectories": [(w.trajectory,)]},
    "accuracy": lambda w: {
        **RUN(w), "t_end": NUMBER, "inputs": [f], "quantities": [{"one": f}], "orders": [(2,)],
        "steps": [(2,)],
        "targets": [(1.0,)], "repeats": WHOLE, "limit_s": NUMBER,
    },
    "contacts": lambda w: {"system": [w.system], "trajectory": [w.trajectory]},
    "balance": lambda w: {"system": [w.system], "trajectory": [w.trajectory]},
    "equilibrium": lambda w: {
        **RUN(w), "loads": NUMBER, "inputs": [f, np.ones(1)], "rotation": V, "about": V, "steps": WHOLE,
        "snap": FLAG, "throw": FLAG,
    },
    "load_path": lambda w: {
        **RUN(w), "arc": NUMBER, "steps": WHOLE, "scale": NUMBER, "inputs": [f], "throw": FLAG
    },
    "modes": lambda w: {**RUN(w), "count": WHOLE, "rotation": V, "inputs": [np.ones(1)], "damped": FLAG},
    "tangent_growth": lambda w: {**RUN(w), **STEPPED, "seed": [0]},
    "plot": lambda w: {
        "system": [w.system], "trajectory": [w.trajectory], "times": [(0.1,)], "beams": [(w.beam,)]
    },
    "animate": lambda w: {
        "system": [w.system], "trajectory": [w.trajectory], "file": ["film.gif"], "fps": WHOLE,
        "beams": [(w.beam,)], "traces": [(w.point,)], "title": NAME, "colour": ["energy", {}],
        "within": [((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))],
    },
    "view": lambda w: {
        "system": [w.system], "trajectory": [w.trajectory], "file": ["view.html"], "title": NAME,
        "follow": [w.body, "body"], "traces": [(w.point,)], "colour": ["energy", {}], "beams": [(w.beam,)],
        "live": FLAG, "within": [((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))],
    },
    **{
        f"System.{name}": lambda w: {"motion": [w.state]}
        for name in ("energy", "momentum", "angular_momentum", "constraint_errors", "work")
    },
    "System.instant": lambda w: {"motion": [w.state], "inputs": [np.ones(1)]},
    "System.sense": lambda w: {
        "motion": [w.state], "part": [w.hinge, w.body, "hinge"], "inputs": [np.ones(1)], "state": [w.state],
        "about": [None, V[0], np.ones(3)],
    },
    "System.get": lambda w: {"part": [w.hinge, w.body, w.motor, "hinge"], "field": [None, "name"]},
    "System.tangent": lambda w: {"motion": [w.state, w.trajectory]},
    "System.coordinate": lambda w: {"motion": [w.state], "joint": [w.hinge, "hinge"], "index": [0]},
    "System.rate": lambda w: {"motion": [w.state], "joint": [w.hinge, "hinge"], "index": [0]},
    "System.with_coordinate": lambda w: {
        "state": [w.state], "joint": [w.hinge, "hinge"], "value": NUMBER, "rate": NUMBER, "index": [0]
    },
    "System.body_index": lambda w: {"body": [w.body, "body"]},
    "System.joint_index": lambda w: {"joint": [w.hinge, "hinge"]},
    "System.input_index": lambda w: {"name": [w.motor, "motor"]},
    "System.report": lambda w: {},
    "System.explain": lambda w: {"trajectory": [w.trajectory]},
    "System.raise_on_failure": lambda w: {"trajectory": [w.trajectory]},
    # control
    "OptimalControl": lambda w: {
        **RUN(w), "dt": [0.1, np.full(2, 0.1)], "steps": [2, (1, 1)], "cost": [nc.cost.Effort()],
        "goal": [nc.goal.Rest()], "phases": [()], "later": [()], "scheme": [nc.EnergyMomentum()],
        "bounds": [nc.bounds.Input(-1.0, 1.0)], "inputs": [nc.inputs.held()], "parameters": [()],
        "free_time": FLAG,
    },
    "Parameter": lambda w: {
        "name": NAME, "where": [f], "index": [(0,), 0], "lower": [-1.0], "upper": NUMBER, "apply": [None, f],
        "value": NUMBER, "moves": FLAG,
    },
    "InitialCoordinate": lambda w: {
        "joint": [w.hinge, "hinge"], "index": [0], "lower": [-1.0], "upper": NUMBER, "value": NUMBER
    },
    "InitialRate": lambda w: {
        "joint": [w.hinge, "hinge"], "index": [0], "lower": [-1.0], "upper": NUMBER, "value": NUMBER
    },
    "InitialState": lambda w: {
        "name": NAME, "apply": [f], "value": NUMBER, "lower": [-1.0], "upper": NUMBER
    },
    "Guess": lambda w: {"inputs": [np.ones((2, 1))], "rates": [np.ones(1)], "free": [np.ones(1)]},
    "optimise": lambda w: {
        "problem": [w.problem], "guess": [np.ones((2, 1))], "progress": FLAG, "time_limit": NUMBER, **SOLVED
    },
    "optimise_jit": lambda w: {
        "problem": [w.problem], "unknowns": [w.unknowns], "options": [Options()]
    },
    "multi_start": lambda w: {
        "problem": [w.problem], "guess": [np.ones((2, 1))], "starts": WHOLE, "spread": NUMBER,
        "rates": NUMBER,
        "seed": [0], **SOLVED,
    },
    "identify": lambda w: {
        **RUN(w), "parameters": [()], "measured": [np.ones((3, 1))], "sensors": [w.hinge, "hinge", f],
        "dt": [0.1], "inputs": [np.ones((2, 1)), f], "guess": [{}], "noise": NUMBER,
        "save_every": WHOLE, "starts": WHOLE, "spread": NUMBER, "seed": [0], "max_evaluations": WHOLE,
        "scheme": [nc.EnergyMomentum()], "progress": FLAG,
    },
    "continuation": lambda w: {
        "problem": [w.problem], "path": [lambda problem, s: problem], "guess": [np.ones((2, 1))],
        "first": NUMBER, "least": NUMBER, "progress": FLAG, "time_limit": NUMBER, **SOLVED,
    },
    "refine": lambda w: {
        "problem": [w.problem, w.solution], "tolerance": NUMBER, "max_rounds": WHOLE, "max_steps": WHOLE,
        "progress": FLAG, "time_limit": NUMBER, **SOLVED,
    },
    "descend": lambda w: {
        "problem": [w.problem], "guess": [np.ones((2, 1))], "optimiser": [optax.sgd(0.1)],
        "iterations": WHOLE,
        "rounds": WHOLE, "penalty": NUMBER, "growth": NUMBER, "tol": NUMBER, "progress": FLAG,
        "time_limit": NUMBER,
    },
    "optimum": lambda w: {"make": [f], "guess": [w.unknowns], "options": [Options()]},
    "check": lambda w: {"solution": [w.solution], "refine": FLAG, "autonomous": FLAG, "make": [f]},
    "regulator": lambda w: {
        "solution": [w.solution], "displacement": NUMBER, "rate": NUMBER, "effort": NUMBER, "final": NUMBER,
        "limits": [(-1.0, 1.0)],
    },
    "receding_horizon": lambda w: {
        "problem": [w.problem], "plant": [w.system], "updates": WHOLE, "steps_each": WHOLE,
        "horizon": ["shrinking"], "iterations": WHOLE, "disturbance": [lambda k, state: state],
        "plant_steps": WHOLE, "guess": [np.ones((2, 1)), w.solution], "max_iterations": WHOLE, "tol": NUMBER,
        "goal_tol": NUMBER,
    },
    "to_nlp": lambda w: {"problem": [w.problem], "guess": [np.ones((2, 1))], "states": FLAG},
    "load_guess": lambda w: {"file": ["guess.json"], "steps": WHOLE},
    "inverse_dynamics": lambda w: {
        **RUN(w), "coordinates": [np.ones((1, 1))], "dt": [0.1], "joints": [(w.hinge,)]
    },
    "computed_torque": lambda w: {
        **RUN(w), "coordinates": [np.ones((1, 1))], "dt": [0.1], "bandwidth": NUMBER, "joints": [(w.hinge,)]
    },
    "io.load": lambda w: {
        "source": [nc.io.PENDULUM], "leave_out": [("limits",)], "floating": FLAG, "motors": FLAG
    },
    "io.read_mesh": lambda w: {"file": ["part.msh"]},
    "io.save_mjcf": lambda w: {**RUN(w), "file": [None, "file.xml"], "name": NAME},
    "testing.check_effect": lambda w: {
        "scene": [w.scene], "effect": [w.motor, w.hinge, "motor"], "inside": FLAG, "seeds": WHOLE,
        "throw": FLAG,
    },
    "cost.Effort": lambda w: {"weight": NUMBER},
    "cost.Duration": lambda w: {"weight": NUMBER},
    "cost.Running": lambda w: {"function": [f], "weight": NUMBER},
    "cost.Terminal": lambda w: {"function": [f], "weight": NUMBER},
    "cost.Missed": lambda w: {"goal": [nc.goal.Rest()], "weight": NUMBER, "rate": NUMBER},
    "cost.InputRate": lambda w: {"weight": NUMBER, "before": NUMBER},
    "cost.Peak": lambda w: {"function": [f], "guess": NUMBER, "weight": NUMBER, "name": NAME},
    "goal.Attitude": lambda w: {"body": [w.body, "body"], "rotation": [np.eye(3)]},
    "goal.Position": lambda w: {"body": [w.body, "body"], "position": V, "point": V},
    "goal.Motion": lambda w: {"body": [w.body, "body"], "velocity": V, "angular_velocity": V},
    "goal.Coordinate": lambda w: {"joint": [w.hinge, "hinge"], "value": NUMBER, "index": [0]},
    "goal.Rate": lambda w: {"joint": [w.hinge, "hinge"], "value": NUMBER, "index": [0]},
    "goal.Rest": lambda w: {},
    "goal.Equal": lambda w: {"function": [f], "name": NAME, "count": WHOLE},
    "goal.Linked": lambda w: {"function": [f], "name": NAME, "count": WHOLE},
    "goal.Periodic": lambda w: {"joints": [(w.hinge,), ("hinge",)]},
    "goal.Integral": lambda w: {"function": [f], "value": NUMBER, "name": NAME},
    "goal.Turned": lambda w: {"body": [w.body, "body"], "axis": V, "angle": NUMBER},
    "goal.At": lambda w: {"goal": [nc.goal.Rest()], "step": WHOLE},
    "goal.Within": lambda w: {"goal": [nc.goal.Rest()], "lower": [-1.0], "upper": NUMBER},
    "goal.Undeformed": lambda w: {"parts": [(("body", "other"),)], "reference": [w.state], "places": FLAG},
    "goal.Equilibrium": lambda w: {},
    "bounds.Input": lambda w: {"lower": [-1.0], "upper": NUMBER, "channel": ["motor"]},
    "bounds.InputRate": lambda w: {"lower": [-1.0], "upper": NUMBER, "channel": ["motor"], "before": NUMBER},
    "bounds.Coordinate": lambda w: {
        "lower": [-1.0], "upper": NUMBER, "joint": [w.hinge, "hinge"], "index": [0]
    },
    "bounds.Rate": lambda w: {"lower": [-1.0], "upper": NUMBER, "joint": [w.hinge, "hinge"], "index": [0]},
    "bounds.KeepOut": lambda w: {"body": [w.body, "body"], "axis": V, "cone": V, "angle": NUMBER},
    "bounds.During": lambda w: {"bound": [nc.bounds.Input(-1.0, 1.0)], "steps": [[(0, 2)]]},
    "bounds.Support": lambda w: {"normal": V, "friction": NUMBER, "least": NUMBER, "unit": NUMBER},
    "bounds.Path": lambda w: {"function": [f], "name": NAME, "count": WHOLE},
    "inputs.Spline": lambda w: {"degree": WHOLE, "every": WHOLE, "shared": [np.ones((1, 1))]},
    "inputs.shared": lambda w: {"matrix": [np.ones((1, 1))], "spline": [nc.inputs.held()]},
    "inputs.held": lambda w: {},
    "inputs.piecewise_linear": lambda w: {"every": WHOLE},
    "inputs.cubic": lambda w: {"every": WHOLE},
}  # fmt: skip

# What calls return or hand over, and bases: nobody is to make these by hand.
MADE = {
    "Accuracy", "Balance", "BeamHandle", "Check", "ComputedTorque", "Contacts", "Continuation",
    "DerivativeError", "Edge", "Equilibrium", "Feedback", "Frame", "Growth", "Horizons", "Identified", "Load",
    "MeshHandle", "Modes", "NodeKind", "Nodes", "NonlinearProgram", "Optima", "Outcome", "Refinement",
    "Result", "SimulationError", "Solution", "State", "Steps", "Surface", "Sweep", "System",
    "Trajectory",
}  # fmt: skip
BASES = {
    "Constraint",
    "DiscreteGap",
    "Field",
    "Force",
    "Gap",
    "Hyperelastic",
    "Joint",
    "MixedPotential",
    "Potential",
    "VelocityConstraint",
}
IN_MODULES = {
    "cost": nc.cost, "goal": nc.goal, "bounds": nc.bounds, "inputs": nc.inputs, "mesh": nc.mesh,
}  # fmt: skip
BASES_IN_MODULES = {
    "cost.Cost", "cost.Sum", "goal.Goal", "goal.All", "bounds.Bound", "bounds.All", "bounds.Range",
    "inputs.Shaping", "mesh.Mesh",
}  # fmt: skip


def called(name):
    """The callable behind a name of the table."""
    owner, _, method = name.rpartition(".")
    if owner in ("System", "Scene"):
        return getattr(world().system if owner == "System" else world().scene, method)
    return getattr(getattr(nc, owner), method) if owner else getattr(nc, name)


def sort_of(value):
    """The sort of thing that a value is."""
    if isinstance(value, Handle):
        return value.kind
    if value is None or isinstance(value, bool | str):
        return str(type(value).__name__)
    return "number" if isinstance(value, int | float) else "object"


def one_of_each_sort():
    """What is fed to an argument that does not take it."""
    return ["nonsense", 90.5, None, world().body, world().hinge, object()]


# --- the table --------------------------------------------------------------------------------------------


def test_everything_public_is_in_the_table():
    names = {n for n in nc.__all__ if callable(getattr(nc, n))} - MADE - BASES
    for module, content in IN_MODULES.items():
        # (Some goals have files of their own: goal_links, goal_places, ...)
        own = (
            n for n, x in vars(content).items() if getattr(x, "__module__", "").startswith(content.__name__)
        )
        names |= {f"{module}.{n}" for n in own if n[0] != "_" and callable(getattr(content, n))}
    for cls in (System, nc.Scene):
        methods = inspect.getmembers(cls, inspect.isfunction)
        names |= {f"{cls.__name__}.{n}" for n, _ in methods if n[0] != "_"}
    names |= {"Section.of_numbers", "Section.of_axis_along_first"}
    names |= {"io.load", "io.read_mesh", "io.save_mjcf", "testing.check_effect"}
    names |= {"Nodes.points", "Nodes.directors", "Nodes.triads"}
    # What `System.set` takes are numbers of the part by name, see `test_parts`.
    names = names - BASES_IN_MODULES - {"System.set"}
    assert names == set(CALLS), f"CALLS, MADE and BASES lack or have too many: {sorted(names ^ set(CALLS))}"


def refused(function, arguments, argument):
    """What is wrong with how a call is refused for one of its arguments; empty if nothing is."""
    try:
        function(**arguments)
    except (TypeError, ValueError) as error:
        last = traceback.extract_tb(error.__traceback__)[-1].filename
        if argument not in str(error):
            return f"the message does not name the argument: {error}"
        if Path(nc.__file__).parent not in Path(last).parents:
            return f"raised in {last}, not by a check of ours: {error}"
        return ""
    except Exception as error:
        return f"raises {error!r}, neither TypeError nor ValueError"
    return "is accepted"


def test_wrong_arguments_are_named():
    wrong = []
    for name in CALLS:
        function, table = called(name), CALLS[name](world())
        parameters = inspect.signature(function).parameters
        if set(parameters) != set(table):
            wrong.append(f"{name}: CALLS has {sorted(table)}, the signature {sorted(parameters)}")
            continue
        fine = {key: values[0] for key, values in table.items()}
        for argument, values in table.items():
            allowed = {sort_of(value) for value in values}
            allowed |= {"NoneType"} if parameters[argument].default is None else set()
            for value in one_of_each_sort():
                if sort_of(value) not in allowed:
                    reason = refused(function, {**fine, argument: value}, argument)
                    wrong += [f"{name}({argument}={value!r}): {reason}"] if reason else []
    assert not wrong, "\n".join(wrong)


CHEAP = [n for n in CALLS if n[0].isupper() and not n.startswith(("Scene", "System"))] + [
    n for n in CALLS if n.partition(".")[0] in IN_MODULES
]


def test_right_arguments_pass():
    wrong = []
    for name in CHEAP:
        function, table = called(name), CALLS[name](world())
        fine = {key: values[0] for key, values in table.items()}
        if name == "LineLoad":  # as a part it is looked at when it is added
            fine["force"] = np.ones(3)
        for argument, values in table.items():
            for value in values:
                if name == "RigidBody" and value is not fine[argument]:
                    continue
                if name == "Parameter" and argument == "apply":
                    continue
                try:
                    function(**{**fine, argument: value})
                except Exception as error:
                    wrong.append(f"{name}({argument}={value!r}) raises {error!r}")
    assert not wrong, "\n".join(wrong)


# --- what the table cannot say ----------------------------------------------------------------------------


def test_what_goes_by_name_says_so():
    w = world()
    for call, words in (
        (lambda: nc.Gravity(-1.62), "vector="),
        (lambda: nc.Revolute(nc.ground, w.body, (0, 0, 1)), "axis="),
        (lambda: nc.JointSpring(w.hinge, 3.0), "stiffness="),
        (lambda: nc.simulate(w.system, w.state, 0.1), "dt="),
        (lambda: nc.JointSpring(w.hinge, stiff=3.0), "'stiff'.*stiffness="),
        (lambda: nc.simulate(w.system, w.state, step=0.1), "'step'.*dt="),
        (
            lambda: nc.PointMass(name="bob"),
            r"PointMass 'bob': mass \[kg\] is missing; pass mass=, a positive",
        ),
        (
            lambda: nc.JointSpring(w.hinge),
            r"JointSpring: stiffness \[.*\] is missing; pass stiffness=, a number",
        ),
        (lambda: nc.Cylinder(0.1), r"Cylinder: length \[m\] is missing"),
        (
            lambda: nc.simulate(w.system, w.state, steps=2),
            r"simulate: dt \[s\] is missing; pass dt=, a positive",
        ),
    ):
        with pytest.raises(TypeError, match=words):
            call()


def test_swapped_arguments_are_told():
    w = world()
    with pytest.raises(ValueError, match="system is .*State.*`state` got one.*swapped"):
        nc.simulate(w.state, w.system, dt=0.1, steps=2)
    with pytest.raises(ValueError, match="motion is the joint 'hinge'.*`part` got one.*swapped"):
        w.system.sense(w.hinge, w.state)


MESSAGES = [
    (lambda w: nc.Gravity(vector=9.81), r"vector \[m/s\^2\] is 9.81; pass .*\(3,\)"),
    (lambda w: nc.Gravity(vector=(0, 9.81)), r"vector \[m/s\^2\] has shape \(2,\)"),
    (
        lambda w: nc.JointTorque(w.body, name="motor"),
        "JointTorque 'motor': joint is the body 'body'; pass",
    ),
    (lambda w: nc.Drive(w.hinge, function=90), "function is 90; pass a function of time"),
    (lambda w: nc.JointSpring(w.hinge, stiffness=-1.0), r"stiffness \[.*\] is -1.0.*nc.JointPotential"),
    (lambda w: nc.Spring(w.ends, stiffness=-1.0), r"stiffness \[N/m\] is -1.0.*nc.NonlinearSpring"),
    (lambda w: nc.JointDamper(w.hinge, damping=-1.0), r"damping \[.*\] is -1.0.*not negative"),
    (lambda w: nc.Armature(w.hinge, inertia=-1.0), r"inertia \[.*\] is -1.0.*not negative"),
    (lambda w: nc.JointStops(w.hinge, stiffness=1.0, lower=1.0, upper=0.0), "lower .* not below upper"),
    (lambda w: nc.Sphere(-1.0), r"radius \[m\] is -1.0; pass a positive number"),
    (lambda w: nc.PointForce(w.point, force=(0, 0, 1)), "markers is a point of the body.*in a tuple"),
    (
        lambda w: nc.simulate(w.system, w.state, dt="0.01", steps=2),
        r"dt \[s\] is '0.01'; pass a positive",
    ),
    (lambda w: nc.simulate(w.system, w.state, dt=0.1, steps=2.0), "steps is 2.0; pass a positive whole"),
    (
        lambda w: nc.simulate(w.system, w.state, dt=0.1, steps=2, scheme="rk4"),
        "scheme is 'rk4'.*nc.Energy",
    ),
    (
        lambda w: nc.simulate(w.system, w.state, dt=0.1, steps=2, until=1.0),
        "until is 1.0; pass a function",
    ),
    (lambda w: nc.plot(w.system, w.state), "trajectory is an object of type State"),
    (lambda w: nc.Scene().add(nc.RigidBody), "part is .*RigidBody"),
]


def test_messages():
    wrong = []
    for make, words in MESSAGES:
        try:
            make(world())
        except (TypeError, ValueError) as error:
            if not re.search(words, str(error)):
                wrong.append(f"'{words}' is not in: {error}")
        except Exception as error:
            wrong.append(f"'{words}' is expected, raised is {error!r}")
        else:
            wrong.append(f"'{words}' is expected, nothing is raised")
    assert not wrong, "\n".join(wrong)


def test_numbers_may_be_traced_and_of_numpy():
    """Under transformations only shapes are known; they are looked at all the same."""
    w = world()
    jax.jit(lambda k: nc.JointSpring(w.hinge, stiffness=k).stiffness)(-1.0)
    jax.vmap(lambda g: nc.Gravity(vector=(0.0, 0.0, g)).vector[2])(jnp.ones(2))
    nc.JointSpring(w.hinge, stiffness=np.float64(2.0), coordinate=np.int32(0))
    with pytest.raises(ValueError, match=r"vector.*shape \(2,\)"):
        jax.jit(lambda g: nc.Gravity(vector=jnp.stack([g, g])).vector)(1.0)


@pytest.mark.slow
def test_a_spread_for_each_input_is_that_of_its_guesses():
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), name="body"))
    scene.add(nc.BodyTorqueInput(tuple(nc.Direction(body, axis) for axis in np.eye(3)), name="torque"))
    fields = {"dt": 0.1, "steps": 4, "cost": nc.cost.Effort(), "goal": nc.goal.Rest()}
    problem, spread = nc.OptimalControl(*scene.compile(), **fields), jnp.array([100.0, 1.0, 0.0])
    middle = Unknowns(jnp.zeros((4, 3)), jnp.zeros(0), jnp.zeros((4, 6)))
    made = jax.vmap(lambda key: scattered(problem, middle, key, spread, 0.0).coefficients)
    sizes = np.std(np.asarray(made(jax.random.split(jax.random.key(0), 200))), axis=(0, 1))
    assert sizes[2] == 0 and sizes[0] == pytest.approx(100 * sizes[1], rel=0.2) and sizes[1] > 0.1


def test_what_needs_a_value_says_so():
    """Numbers that are part of the program, and what Python reads."""
    w = world()
    for argument, call in (
        ("newton_tol", lambda x: nc.step(w.system, w.state, dt=0.1, newton_tol=x).q),
        ("newton_tol", lambda x: nc.simulate(w.system, w.state, dt=0.1, steps=2, newton_tol=x).q),
        ("tol", lambda x: nc.optimise(w.problem, tol=x).cost),
        ("problem", lambda x: nc.optimise(dataclasses.replace(w.problem, dt=x)).cost),
        ("trajectory", lambda x: nc.balance(w.system, eqx.tree_at(lambda t: t.t, w.trajectory, x)).energy),
    ):
        with pytest.raises(ValueError, match=f"{argument}.* is traced .* needs a value"):
            jax.jit(call)(1e-9)


def test_a_scene_may_be_compiled_twice():
    first, second = (world().scene.compile()[0] for _ in range(2))
    assert eqx.tree_equal(first, second)


def test_all_that_computes_asks_for_double_precision():
    """A scene built in double precision and used outside of it is refused, not computed in single."""
    w = world()
    calls = {name: CALLS[name](w) for name in CALLS if not name.startswith(("cost", "goal"))}
    parts = {n for n in calls if inspect.isclass(called(n)) and not getattr(called(n), "makes_arrays", False)}
    parts -= {"Scene"}
    asked = set(calls) - parts - {"System.report"}
    assert {"simulate", "System.energy", "System.sense", "balance", "modes", "Scene", "Box", "Point"} <= asked
    sensor = w.system.sense(w.state, w.hinge)
    energy = w.system.energy(w.state)
    with jax.enable_x64(False):
        for name in sorted(asked):
            fine = {key: values[0] for key, values in calls[name].items()}
            with pytest.raises(ValueError, match="double precision"):
                called(name)(**fine)
        for late in (lambda: sensor.force, lambda: energy.total):
            with pytest.raises(ValueError, match="double precision"):
                late()


# --- defaults, and inertia as it is printed -----------------------------------------------------------------


def test_points_are_the_bodies_reference_points_by_default():
    scene = nc.Scene()
    mass = scene.add(nc.PointMass(mass=1.0, position=(1, 0, 0), name="mass"))
    scene.add(nc.Spring((nc.Point(nc.ground, (1, 0, 2)), nc.Point(mass)), stiffness=3.0))
    rod = scene.add(nc.PointMass(mass=1.0, position=(4, 4, 0), name="end"))
    scene.add(nc.Distance(mass, rod))
    system, state = scene.compile()
    assert float(system.energy(state).total) == pytest.approx(0.5 * 3 * 2**2)
    assert float(system.sense(state, nc.Point(mass)).position[0]) == 1.0
    assert float(system.sense(state, system.structure.joints[-1]).distance) == pytest.approx(5.0)


def test_inertia_rounded_in_print():
    """A thin plate with three digits breaks the triangle inequality by rounding; with two it is refused."""
    scene = nc.Scene()
    scene.add(nc.RigidBody(mass=1.0, inertia=(0.00333, 0.00333, 0.00667), angular_velocity=(0, 0, 2.0)))
    system, state = scene.compile()
    assert float(system.energy(state).total) == pytest.approx(0.5 * 0.00667 * 4, rel=1e-12)
    with pytest.raises(ValueError, match=r"nearest possible inertia.*\[0.00335, 0.00335, 0.0067 \]"):
        nc.RigidBody(mass=1.0, inertia=(0.0033, 0.0033, 0.0067))
    nc.RigidBody(mass=1.0, inertia=(0.00335, 0.00335, 0.0067))
    with pytest.raises(ValueError, match="belongs to no body"):
        nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, -0.004))


# --- what is returned: items, prints, files -----------------------------------------------------------------


def test_a_trajectory_has_items():
    """`trajectory[k].t` is `trajectory.t[k]`, for states, pieces and lanes alike."""
    w = world()
    run = nc.simulate(w.system, w.state, dt=0.1, inputs=jnp.arange(6.0)[:, None])
    assert len(run) == 7 and [float(s.t) for s in run] == run.t.tolist()
    for index in (0, 3, -1, np.int64(2)):
        assert float(run[index].t) == float(run.t[index])
        np.testing.assert_array_equal(run[index].q, run.q[index])
    for index in (slice(2, 5), slice(None, None, 2), slice(-3, None), slice(4, 5)):
        piece = run[index]
        np.testing.assert_array_equal(piece.t, run.t[index])
        starts = np.arange(7)[index]
        np.testing.assert_array_equal(piece.inputs, run.inputs[starts[1:] - 1])
    piece = run[2:5]
    assert float(nc.balance(w.system, piece).energy.max()) <= 1e-14
    assert nc.balance(w.system, piece).axes == 1 and nc.balance(w.system, run[::2]).axes == 0
    for index, error in ((7, IndexError), (-8, IndexError), (slice(5, 5), IndexError), ("a", TypeError)):
        with pytest.raises(error, match="trajectory"):
            run[index]
    lanes = jax.vmap(lambda dt: nc.simulate(w.system, w.state, dt=dt, steps=2))(jnp.array([0.1, 0.2, 0.3]))
    assert len(lanes) == 3 and lanes[1].t.tolist() == [0.0, 0.2, 0.4] and lanes[1:].t.shape == (2, 3)
    assert float(jax.jit(lambda run: run[-1].t)(run)) == float(run.t[-1])


class Spoilt(nc.Force):
    """No force, and none at all after a time [s]."""

    end: float = 1.0

    def load(self, x, rate, inputs, t):
        """Zero, or NaN."""
        return nc.Load(0.0 * jnp.sqrt(self.end - t) * jnp.ones_like(x), None)


def test_a_batch_is_explained_by_reason_and_part():
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, velocity=(1.0, 0.0, 0.0), name="ball"))
    scene.add(Spoilt((nc.Point(ball),), name="spoilt"))
    system, state = scene.compile()
    steps = jnp.linspace(0.1, 1.0, 10)
    runs = jax.vmap(lambda dt: nc.simulate(system, state, dt=dt, steps=4))(steps)
    words = system.explain(runs).splitlines()
    failed = int((np.asarray(runs.result) != 0).sum())
    assert 0 < failed < 10 and words[0] == f"{failed} of 10 lanes failed" and len(words) > 1
    first = int(np.argmax(np.asarray(runs.result) != 0))
    counts = [int(line.partition(":")[0]) for line in words[1:]]
    assert sum(counts) == failed and counts == sorted(counts, reverse=True)
    assert all("'ball'" in line for line in words[1:]) and f"first lane {first} in" in "".join(words)
    assert system.explain(runs[:1]) == "none of 1 lanes failed"
    with pytest.raises(nc.SimulationError, match="lanes failed"):
        system.raise_on_failure(runs)


def test_prints_show_the_largest():
    w = world()
    run = nc.simulate(w.system, w.state, dt=0.1, steps=5)
    errors, balance = w.system.constraint_errors(run), nc.balance(w.system, run)
    assert f"director_rates {float(errors.director_rates.max()):.2g} [1/s]" in str(errors)
    assert f"{balance.energy.max():.2g}" in str(balance) and balance.note in str(balance)
    jax.jit(lambda run: repr(w.system.constraint_errors(run)) and run.t)(run)


def test_files_hold_trajectories(tmp_path):
    w = world()
    run, other = (nc.simulate(w.system, w.state, dt=dt, steps=2) for dt in (0.1, 0.2))
    eqx.tree_serialise_leaves(tmp_path / "run.eqx", run)
    again = eqx.tree_deserialise_leaves(tmp_path / "run.eqx", other)
    assert eqx.tree_equal(run, again) and not eqx.tree_equal(run, other)


def test_version(capsys):
    import tomllib

    from natcoord_jax import cli

    project = tomllib.loads((Path(nc.__file__).parents[1] / "pyproject.toml").read_text("utf-8"))["project"]
    assert nc.__version__ == project["version"]
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0 and project["version"] in capsys.readouterr().out


def test_no_advice_that_cannot_help():
    """A load that does not grow is not reached by more steps of it."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    scene.add(nc.PointMass(mass=1.0, name="ball"))
    falling = scene.compile()
    with pytest.raises(nc.SimulationError, match="nothing that acts depends on the load parameter") as caught:
        nc.equilibrium(*falling)
    assert "more steps" not in str(caught.value)
