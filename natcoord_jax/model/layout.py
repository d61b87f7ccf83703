"""The layout of a system: numbers of bodies, joints, coordinates and channels, and the initial state."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.bodies import NODE, TRIAD, NodeKind
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.coordinate import Coordinate, CoordinateEffect
from natcoord_jax.core.eager_numpy import eager_numpy, stacked
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.force import Field
from natcoord_jax.core.handles import Handle, ground
from natcoord_jax.core.joint import Joint, frames_at
from natcoord_jax.core.markers import Attachment, Marker
from natcoord_jax.core.names import names_of
from natcoord_jax.core.potential import place_markers
from natcoord_jax.core.state import State
from natcoord_jax.model.assembled_poses import (
    Poses,
    check_joint,
    coupled_pairs,
    edge_of,
    joint_frames,
    joint_triad,
    padded,
    rows_and_velocities,
    rows_of_poses,
    with_masses,
)
from natcoord_jax.model.bodies import Bodies, picked
from natcoord_jax.model.graph import Edge, spanning_tree
from natcoord_jax.model.grouping import Instance, bare, families
from natcoord_jax.model.groups import CoordinateGroup


class Layout:
    """Numbers of everything: bodies along the tree, joints with those of the tree first, channels."""

    def __init__(self, bodies: Bodies, joints: dict[str, Joint], effects: dict[str, Effect]):
        self.bodies, self.joints = bodies, joints
        self.poses = Poses(bodies)
        self.names = list(joints)
        self.edges = [edge_of(name, j, self.poses, bodies.sets) for name, j in joints.items()]
        couplings = coupled_pairs(effects, self.poses, bodies.sets)
        self.spanning = spanning_tree(len(bodies), self.edges, couplings, bodies.sets)
        self.order = np.array(self.spanning.order, int)
        self.body_number = np.argsort(np.append(self.order, len(bodies)))
        carriers = self.spanning.carrier
        loops = [j for j in range(len(self.names)) if j not in carriers]
        self.joint_order = [*carriers, *loops]
        self.joint_number = {self.names[j]: i for i, j in enumerate(self.joint_order) if j >= 0}
        self.coordinates: list[tuple[str, int, Coordinate]] = []
        for name, joint in joints.items():
            self.coordinates += [(name, k, axis) for k, axis in enumerate(joint.coordinates)]
        self.coordinate_number = {(name, k): i for i, (name, k, _) in enumerate(self.coordinates)}
        self.inputs: list[str] = []
        self.works: list[str] = []
        self.rotors: list[int] = []

    def body(self, handle: Handle) -> int:
        """Number of a body in the system."""
        return int(self.body_number[self.poses.of(handle)])

    def nodes(self, name: str) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 4 4"]]:
        """Of all nodes of a set their body's number in the scene, and their rows as weights of its rows."""
        numbers = self.bodies.places(name)
        rows = np.broadcast_to(np.eye(4), (len(numbers), 4, 4)).copy()
        for clamp in (clamp for clamp in self.bodies.clamps if clamp.nodes.name == name):
            members, owner = clamp.nodes.numbers, clamp.body
            numbers[members] = self.poses.of(owner)
            for k in members:
                held = self.poses.held(Handle("body", f"{name}[{k}]", owner.scene))
                if not is_concrete(held):
                    raise ValueError(
                        f"nodes {name!r}: some are clamped, and the scene is compiled in a traced function; "
                        "compile it outside of jit and grad, and pass what varies by system.set"
                    )
                rows[k] = np.asarray(held)
        return numbers, rows

    def masses(self) -> Float[Array, "bodies 4 4"]:
        """Mass blocks of the bodies, with those of what is clamped to them, in the order of the system."""
        found = self.bodies.every("mass_block")
        for clamp in self.bodies.clamps:
            if clamp.body != ground:
                name, members = clamp.nodes.name, clamp.nodes.numbers
                rows, own = self.nodes(name)[1][members], self.bodies.node_masses(name, members)
                found = with_masses(found, as_array(self.poses.of(clamp.body)), as_array(rows), own)
        return picked(found, self.order)

    def every(self, field: str) -> Array:
        """A field of all bodies, in the order of the system."""
        return picked(self.bodies.every(field), self.order)

    @property
    def kinds(self) -> list[NodeKind]:
        """What bodies carry and how they turn, in the order of the system."""
        return [self.bodies.kinds[k] for k in self.order]

    @property
    def ordered_names(self) -> Sequence[str]:
        """Names of the bodies, in the order of the system: sets come first there, too."""
        sets = [run for run in self.bodies.runs if run[1] is not None]
        return names_of([*sets, *((self.bodies.names[int(k)], None) for k in self.order[self.bodies.sets :])])

    @property
    def ordered_joints(self) -> Sequence[str]:
        """Names of the joints, those of the tree first; none of free bodies."""
        sets = self.bodies.sets
        names = [(self.names[j] if j >= 0 else "", None) for j in self.joint_order[sets:]]
        return names_of([("", (range(sets),)), *names] if sets else names)

    def motions(self) -> list[Edge]:
        """Free motion of each body relative to its parent in the tree."""
        motions = []
        for own, carrier in zip(self.kinds, self.spanning.carrier):
            every = tuple(range(3))
            edge = self.edges[carrier] if carrier >= 0 else Edge(0, 0, every, every, False, True)
            if own != TRIAD:
                rotations = own.turns if carrier < 0 else ()
                edge = replace(edge, rotations=rotations, child_rotation=False, own_axes=bool(rotations))
            motions.append(edge)
        return motions

    def frames(self) -> Float[Array, "joints 2 4 4"]:
        """Frames of all joints; a free body's coincide with its reference frame and the ground's."""
        free = as_array(np.stack([np.eye(4)] * 2))
        listed = list(self.joints.values())
        return stacked([joint_frames(listed[j], self.poses) if j >= 0 else free for j in self.joint_order])

    def joint_bodies(self) -> np.ndarray:
        """Parent and child of every joint, as the scene names them."""
        rows = [
            [self.body_number[b] for b in (self.edges[j].parent, self.edges[j].child)]
            if j >= 0
            else [len(self.bodies), number]
            for number, j in enumerate(self.joint_order)
        ]
        return np.array(rows, np.int32).reshape(-1, 2)

    def joint_instances(self) -> list[Instance]:
        """Constraints of all joints."""
        instances = []
        for name, joint in self.joints.items():
            place = joint_frames(joint, self.poses)
            ends = np.array([self.poses.of(handle) for handle in (joint.parent, joint.child)])
            frames = _frames_at(place, self.rows_at(ends))
            ready = joint.initialise(*frames)
            kinds = [self.bodies.kind_of(handle) for handle in (joint.parent, joint.child)]
            check_joint(name, ready, kinds, place, frames)
            instances.append(
                Instance(
                    name,
                    bare(ready, ready.assembling, f"joint {name!r}"),
                    "joint",
                    [self.body(joint.parent), self.body(joint.child)],
                    joints=[self.joint_number[name]],
                    in_tree=self.joint_number[name] < len(self.bodies),
                )
            )
        return instances

    def rows_at(self, numbers: np.ndarray) -> Float[Array, "*n 4 3"]:
        """Rows of bodies in the assembled pose, by their numbers in the scene."""
        some = (picked(x, numbers.reshape(-1)) for x in (self.poses.position, self.poses.rotation))
        return rows_of_poses(*some).reshape(*numbers.shape, *NODE)

    def effect_instance(self, name: str, effect: Effect) -> Instance:
        """Where an effect sits, and its channels."""
        label = f"effect {name!r}"
        if isinstance(effect, Field):
            instance = Instance(name, bare(effect, ("name",), label), "mass", [])
        elif isinstance(effect, CoordinateEffect):
            instance = self._on_coordinates(name, effect, label)
        else:
            instance = self._on_markers(name, effect, label)
        count = effect.inputs
        instance.inputs = list(range(len(self.inputs), len(self.inputs) + count))
        self.inputs += [name] if count == 1 else [f"{name}[{k}]" for k in range(count)]
        return instance

    def number_accounts(self, instances: list[Instance]) -> None:
        """Places in the work account and among the stored rates: one piece of the state for each group."""
        for instance in (x for family in families(instances) for x in family):
            if instance.effect.works:
                instance.works = [len(self.works)]
                self.works.append(instance.name)
            if instance.effect.rotors:
                instance.rotors = [len(self.rotors)]
                self.rotors += instance.coordinates

    def _on_markers(self, name: str, effect: Any, label: str) -> Instance:
        markers = effect.attach(
            lambda handle: (self.joints[handle.name], joint_triad(self.joints[handle.name]))
        )
        kinds = Marker, Attachment
        if not isinstance(markers, tuple | list) or not any(
            all(isinstance(m, kind) for m in markers) for kind in kinds
        ):
            raise ValueError(
                f"{label}: markers must be a tuple of nc.Point and nc.Direction, or one of nc.Attachment, "
                f"not {markers!r}"
            )
        weights, bodies = self._weighted(markers)
        if effect.unit_directions:
            weights = _with_unit_directions(weights, self.rows_at(np.array(bodies)))
        if type(effect).assembled_at is not Effect.assembled_at:
            effect = effect.assembled_at(_place_markers(weights, self.rows_at(np.array(bodies))))
        drop = [f for f in ("markers", "name", "joint") if f in type(effect).__dataclass_fields__]
        numbers = [int(self.body_number[b]) for b in bodies]
        return Instance(name, bare(effect, drop, label), "markers", numbers, weights=weights)

    def _weighted(self, markers: Any) -> tuple[Array, list[int]]:
        """Weights of markers (k, ..., 4 b), and numbers in the scene of the b bodies of each in turn.

        What has fewer bodies than others has the ground for the rest, without weight.
        """
        own = [[self.poses.carrier(handle) for handle in getattr(m, "handles", (m.body,))] for m in markers]
        most = max(map(len, own))
        weights = [self.poses.weights(m) for m in markers]
        if most > 1:
            weights = [padded(w, TRIAD.rows * most) for w in weights]
        rest = len(self.bodies)
        return stacked(weights), [b for x in own for b in (*x, *(rest,) * (most - len(x)))]

    def _on_coordinates(self, name: str, effect: CoordinateEffect, label: str) -> Instance:
        many = isinstance(effect.joint, tuple)
        handles = effect.joint if many else (effect.joint,)
        given = effect.coordinate
        indices = given if isinstance(given, tuple | list) else (given,) * len(handles)
        if len(indices) != len(handles):
            raise ValueError(
                f"{label}: {len(indices)} coordinate indices for {len(handles)} joints; pass one for each, "
                "or one integer for all"
            )
        numbers, bodies, axes = [], [], []
        for handle, index in zip(handles, indices):
            joint = self.joints[handle.name]
            if not joint.coordinates:
                turns = len(joint.rotations) == 3 and effect.on_a_ball
                kind = f"joint {handle.name!r}, a {type(joint).__name__} joint, has no coordinates"
                remedy = f"use {effect.on_a_ball}" if turns else "pass another joint"
                raise ValueError(f"{label}: {kind}; {remedy}")
            if not 0 <= index < len(joint.coordinates):
                raise ValueError(
                    f"{label}: joint {handle.name!r} has {len(joint.coordinates)} coordinates, "
                    f"no number {index}; a {type(joint).__name__} joint counts them from 0"
                )
            numbers.append(self.coordinate_number[(handle.name, index)])
            bodies += [self.body(joint.parent), self.body(joint.child)]
            axes.append(joint.coordinates[index])
        stripped = bare(replace_fields(effect, axes=tuple(axes)), ("joint", "coordinate", "name"), label)
        joints = [self.joint_number[h.name] for h in handles]
        return Instance(name, stripped, "coordinates", bodies, joints=joints, coordinates=numbers)

    def coordinate_groups(self) -> tuple[CoordinateGroup, ...]:
        """Joint coordinates by description."""
        families: dict[Coordinate, list[int]] = {}
        for i, (_, _, axis) in enumerate(self.coordinates):
            families.setdefault(axis, []).append(i)
        groups = []
        for axis, members in families.items():
            joints = [self.joint_number[self.coordinates[i][0]] for i in members]
            groups.append(CoordinateGroup(axis, np.array(joints, np.int32), np.array(members, np.int32)))
        return tuple(groups)

    def coordinate_order(self) -> np.ndarray:
        """Place of each coordinate among those of all groups, one group after the other."""
        listed = [group.index for group in self.coordinate_groups()]
        return np.argsort(np.concatenate([np.zeros(0, np.int32), *listed])).astype(np.int32)

    def state(self) -> State:
        """Initial state: coordinates count from the assembled pose."""
        q, v = rows_and_velocities(*(self.every(name) for name in MOTION))
        angles = [as_array(self.joints[name].assembled(k), float) for name, k, _ in self.coordinates]
        return State(
            as_array(0.0),
            q,
            v,
            stacked(angles) if angles else as_array(np.zeros(0)),
            *(as_array(np.zeros(len(x))) for x in (self.rotors, self.works)),
        )


MOTION = "position", "rotation", "velocity", "angular_velocity"
"""What the rows of a body and their velocities are made of."""

_frames_at = eager_numpy(frames_at)


@eager_numpy
def _with_unit_directions(weights: Float[Array, "k w"], rows: Float[Array, "b 4 3"]) -> Array:
    """Weights of markers, those of directions such that they are unit vectors in the assembled pose."""
    sizes = jnp.sqrt(jnp.sum(jnp.square(place_markers(weights, rows)), axis=1))
    # Rounding of unit vectors is left as it is.
    fine = jnp.any(weights[:, ::4] != 0, axis=1) | (jnp.abs(sizes - 1.0) <= 4.0 * jnp.finfo(sizes.dtype).eps)
    return weights / jnp.where(fine, 1.0, sizes)[:, None]


_place_markers = eager_numpy(place_markers)
