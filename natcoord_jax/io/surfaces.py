"""What is drawn of the links: shapes and meshes as points and faces."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from natcoord_jax.bodies.shapes import AROUND, Box, Cylinder, Ellipsoid, Sphere, Surface
from natcoord_jax.io.links import Poses
from natcoord_jax.io.notes import Notes, mujoco


class LinkSurface(eqx.Module):
    """Everything that is drawn of a link.

    Attributes:
        points: in the frame of the link [m].
        corners: numbers of the points around all faces, one face after the other.
        starts: where each face starts among the corners, and their number.
        colours: red, green, blue, opaqueness of each face, 0 to 1.
    """

    points: Float[np.ndarray, "n 3"]
    corners: Int[np.ndarray, " c"]
    starts: Int[np.ndarray, " faces_and_one"]
    colours: Float[np.ndarray, "faces 4"]

    def surface(self) -> Surface:
        """Points from the reference point of the body [m], and faces."""
        corners, starts = np.asarray(self.corners, int), np.asarray(self.starts, int)
        return np.asarray(self.points), np.split(corners, starts[1:-1])


def read_surfaces(model: Any, poses: Poses, notes: Notes) -> dict[int, LinkSurface]:
    """Surfaces of the links, by their number."""
    pieces: dict[int, list[tuple[np.ndarray, list[np.ndarray], np.ndarray]]] = {}
    for geom in _drawn(model, poses):
        body = int(model.geom_bodyid[geom])
        surface = _surface(model, geom)
        if surface is None:
            kind = mujoco().mjtGeom(int(model.geom_type[geom])).name.rpartition("_")[2].lower()
            notes.left_out(model.geom(geom).name or f"a {kind}", f"what has the shape {kind} is not drawn")
            continue
        turned = np.zeros(9)
        mujoco().mju_quat2Mat(turned, model.geom_quat[geom])
        frame = poses.in_body(body, model.geom_pos[geom], turned.reshape(3, 3))
        points = frame.position + surface[0] @ frame.rotation.T
        pieces.setdefault(frame.link, []).append((points, surface[1], _colour(model, geom)))
    return {link: _joined(parts) for link, parts in pieces.items()}


def _drawn(model: Any, poses: Poses) -> list[int]:
    """Of each link the geoms that are only seen, or if there are none those that collide."""
    seen = (model.geom_contype == 0) & (model.geom_conaffinity == 0)
    links = np.array([poses.link_of[body] for body in model.geom_bodyid], int)
    has = {int(link) for link, only in zip(links, seen) if only}
    return [g for g in range(model.ngeom) if links[g] >= 0 and (seen[g] or int(links[g]) not in has)]


def _colour(model: Any, geom: int) -> np.ndarray:
    material = int(model.geom_matid[geom])
    plain = np.allclose(model.geom_rgba[geom], (0.5, 0.5, 0.5, 1.0))
    return np.array(model.mat_rgba[material] if material >= 0 and plain else model.geom_rgba[geom], float)


def _surface(model: Any, geom: int) -> Surface | None:
    """Points and faces in the frame of the geom."""
    kind, size = mujoco().mjtGeom(int(model.geom_type[geom])), np.array(model.geom_size[geom])
    if kind.name == "mjGEOM_MESH":
        mesh = int(model.geom_dataid[geom])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        start, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        points = np.array(model.mesh_vert[first : first + count], float)
        return points, list(np.array(model.mesh_face[start : start + faces], int))
    if kind.name == "mjGEOM_BOX":
        return Box(2 * size).surface()
    if kind.name == "mjGEOM_SPHERE":
        return Sphere(size[0]).surface()
    if kind.name == "mjGEOM_ELLIPSOID":
        return Ellipsoid(size).surface()
    if kind.name == "mjGEOM_CYLINDER":
        return Cylinder(size[0], 2 * size[1]).surface()
    if kind.name == "mjGEOM_CAPSULE":
        points, faces = Sphere(size[0]).surface()
        # The upper half of the globe goes up, the lower half down, by half the length between the caps.
        ring = np.arange(len(points)) // AROUND
        return points + np.where(ring > ring.max() / 2, size[1], -size[1])[:, None] * (0.0, 0.0, 1.0), faces
    return None


def _joined(pieces: list[tuple[np.ndarray, list[np.ndarray], np.ndarray]]) -> LinkSurface:
    """Several surfaces as one."""
    points, corners, lengths, colours, before = [], [], [0], [], 0
    for own, faces, colour in pieces:
        points.append(own)
        corners += [np.asarray(face, int) + before for face in faces]
        lengths += [len(face) for face in faces]
        colours += [colour] * len(faces)
        before += len(own)
    return LinkSurface(np.concatenate(points), np.concatenate(corners), np.cumsum(lengths), np.array(colours))
