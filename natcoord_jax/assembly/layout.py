"""The layout of a system: numbers of bodies, joints, coordinates and channels, and the initial state."""

from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.assembly.graph import Edge, spanning_tree
from natcoord_jax.assembly.grouping import Instance, bare, families
from natcoord_jax.assembly.poses import Poses, joint_frames, joint_triad
from natcoord_jax.assembly.rates import row_rates
from natcoord_jax.assembly.system import CoordinateGroup
from natcoord_jax.core.bodies import Body
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.coordinate import Coordinate, CoordinateEffect
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.force import Field
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.host import on_host, stacked
from natcoord_jax.core.joint import Joint, frames_at
from natcoord_jax.core.markers import Attachment, Marker
from natcoord_jax.core.potential import place_markers
from natcoord_jax.core.state import State

JOINT_FIELDS = ("parent", "child", "point", "axis", "second", "name", "parent_point")


def _edge(joint: Joint, poses: Poses) -> Edge:
    return Edge(
        poses.of(joint.parent),
        poses.of(joint.child),
        joint.rotations,
        joint.translations,
        joint.child_rotation,
        joint.free,
    )


def _couplings(effects: dict[str, Effect], poses: Poses) -> list[tuple[int, int]]:
    """Pairs of neighbouring bodies of the effects that make neighbours of them."""
    found = []
    for effect in effects.values():
        if effect.couples:
            markers: Any = getattr(effect, "markers", ())
            listed = [poses.of(m.body) for m in markers]
            found += list(pairwise(listed))
    return found


class Layout:
    """Numbers of everything: bodies along the tree, joints with those of the tree first, channels."""

    def __init__(self, bodies: dict[str, Body], joints: dict[str, Joint], effects: dict[str, Effect]):
        self.bodies, self.joints = bodies, joints
        self.poses = Poses(bodies)
        self.names = list(joints)
        self.edges = [_edge(j, self.poses) for j in joints.values()]
        self.spanning = spanning_tree(len(bodies), self.edges, _couplings(effects, self.poses))
        self.body_number = {old: new for new, old in enumerate(self.spanning.order)}
        self.body_number[len(bodies)] = len(bodies)
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
        return self.body_number[self.poses.of(handle)]

    def ordered_bodies(self) -> list[Body]:
        """Bodies in the order of the system."""
        listed = list(self.bodies.values())
        return [listed[i] for i in self.spanning.order]

    def motions(self) -> list[Edge]:
        """Free motion of each body relative to its parent in the tree."""
        motions = []
        for body, carrier in zip(self.ordered_bodies(), self.spanning.carrier):
            every = tuple(range(3))
            edge = self.edges[carrier] if carrier >= 0 else Edge(0, 0, every, every, False, True)
            if not body.oriented:
                edge = Edge(edge.parent, edge.child, (), edge.translations, False, True)
            motions.append(edge)
        return motions

    def frames(self) -> Float[Array, "joints 2 4 4"]:
        """Frames of all joints; a free body's coincide with its reference frame and the ground's."""
        free = as_array(np.stack([np.eye(4)] * 2))
        listed = list(self.joints.values())
        return stacked([joint_frames(listed[j], self.poses) if j >= 0 else free for j in self.joint_order])

    def joint_bodies(self) -> np.ndarray:
        """Parent and child of every joint, as the scene names them."""
        rows = []
        for number, j in enumerate(self.joint_order):
            if j >= 0:
                edge = self.edges[j]
                rows.append([self.body_number[edge.parent], self.body_number[edge.child]])
            else:
                rows.append([len(self.bodies), number])
        return np.array(rows, np.int32).reshape(-1, 2)

    def joint_instances(self) -> list[Instance]:
        """Constraints of all joints."""
        instances = []
        for name, joint in self.joints.items():
            frames = _frames_at(joint_frames(joint, self.poses), self._rows(joint))
            ready = joint.initialise(*frames)
            instances.append(
                Instance(
                    name,
                    bare(ready, JOINT_FIELDS, f"joint {name!r}"),
                    "joint",
                    [self.body(joint.parent), self.body(joint.child)],
                    joints=[self.joint_number[name]],
                    in_tree=self.joint_number[name] < len(self.bodies),
                )
            )
        return instances

    def _rows(self, joint: Joint) -> Float[Array, "2 4 3"]:
        poses = self.poses
        pair = [poses.of(joint.parent), poses.of(joint.child)]
        return _rows([poses.position[b] for b in pair], [poses.rotation[b] for b in pair])

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

    def _angles(self) -> Float[Array, " coordinates"]:
        """Joint coordinates in the assembled pose, as far as they are angles."""
        found = [self.joints[name].assembled(k) for name, k, _ in self.coordinates]
        return stacked([as_array(x, float) for x in found]) if found else as_array(np.zeros(0))

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
        weights = stacked([self.poses.weights(m) for m in markers])
        if type(effect).assembled_at is not Effect.assembled_at:
            effect = effect.assembled_at(self._placed(markers, weights))
        drop = [f for f in ("markers", "name", "joint") if f in type(effect).__dataclass_fields__]
        bodies = [self.body(m.body) for m in markers]
        return Instance(name, bare(effect, drop, label), "markers", bodies, weights=weights)

    def _placed(self, markers: Any, weights: Array) -> Array:
        """Where markers are in the assembled pose."""
        bodies = [self.poses.of(m.body) for m in markers]
        rows = _rows([self.poses.position[b] for b in bodies], [self.poses.rotation[b] for b in bodies])
        return _place_markers(weights, rows)

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
        bodies = self.ordered_bodies()
        motion = [[getattr(b, name) for b in bodies] for name in MOTION]
        q, v = _rows_and_velocities(*motion)
        return State(
            as_array(0.0),
            q,
            v,
            self._angles(),
            *(as_array(np.zeros(len(x))) for x in (self.rotors, self.works)),
        )


MOTION = "position", "rotation", "velocity", "angular_velocity"
"""What the rows of a body and their velocities are made of."""

_frames_at = on_host(frames_at)
_place_markers = on_host(place_markers)


def _stacked_rows(points: list[Array], rotations: list[Array]) -> Float[Array, "n 4 3"]:
    return jnp.concatenate([jnp.stack(points)[:, None], jnp.stack(rotations).swapaxes(1, 2)], axis=1)


_rows = on_host(_stacked_rows)


@on_host
def _rows_and_velocities(
    points: list[Array], rotations: list[Array], velocities: list[Array], spins: list[Array]
) -> tuple[Float[Array, "rows 3"], Float[Array, "rows 3"]]:
    rows = _stacked_rows(points, rotations)
    rates = row_rates(rows, jnp.stack(velocities), jnp.stack(spins))
    return rows.reshape(-1, 3), rates.reshape(-1, 3)
