"""The view served by viser, for what runs on another machine or does not fit into a file."""

import threading
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from natcoord_jax.maths.rotations import to_quaternion
from natcoord_jax.viz.packed import triangles
from natcoord_jax.viz.scenery import Scenery, Skin, Solid, along_map


def _viser() -> Any:
    try:
        import viser
    except ImportError:
        raise ImportError(
            "view: live=True is drawn by viser, which is not installed; python -m pip install "
            '"natcoord-jax[viz3d]", or leave it out for a file'
        ) from None
    return viser


def _quaternions(rows: np.ndarray) -> np.ndarray:
    """Unit quaternions (t, 4) of frames (t, 4, 3); no turn where there is none."""
    there = np.asarray(np.isfinite(rows).all(axis=(1, 2)))
    frames = np.where(there[:, None, None], rows[:, 1:], np.eye(3))
    return np.asarray(to_quaternion(jnp.asarray(np.swapaxes(frames, 1, 2))))


class Live:
    """A view that is served on this machine, with its controls.

    Attributes:
        address: where a browser finds it.
        server: of viser.

    Raises:
        ImportError: without viser.
    """

    def __init__(self, lanes: Sequence[Scenery], pace: float, follow: str):
        server = _viser().ViserServer(host="127.0.0.1", verbose=False)
        self.server, self.lanes, self.pace = server, lanes, pace
        self.address = f"http://127.0.0.1:{server.get_port()}"
        first = lanes[0]
        self.moved = [self._added(k, solid) for k, solid in enumerate(first.solids)]
        self.turned = [[_quaternions(s.rows) if s.rigid else None for s in lane.solids] for lane in lanes]
        server.scene.set_up_direction(tuple(first.up))
        if first.ground is not None:
            across = int(np.abs(first.up).argmax())
            plane: Any = {0: "yz", 1: "xz", 2: "xy"}[across]
            place = tuple(first.ground * first.up)
            server.scene.add_grid("/ground", width=20 * first.size, height=20 * first.size, plane=plane,
                                  position=place, cell_size=first.reach / 5)  # fmt: skip
        middle = first.extent.mean(axis=0)
        server.initial_camera.look_at = tuple(middle)
        server.initial_camera.position = tuple(middle + 1.4 * first.size * first.eye())
        gui, end = server.gui, float(first.t[-1] - first.t[0])
        gui.add_markdown(f"**{first.title}**")
        self.playing = gui.add_checkbox("play", True)
        self.now = gui.add_slider("time [s]", 0.0, max(end, 1e-9), max(end, 1e-9) / 1000, 0.0)
        self.speed = gui.add_slider("speed", 0.05, 4.0, 0.05, 1.0)
        self.follow = gui.add_dropdown(
            "follow", ("nothing", *first.bodies), initial_value=follow or "nothing"
        )
        self.lane = gui.add_slider("run", 1, max(len(lanes), 2), 1, 1, visible=len(lanes) > 1)
        self.now.on_update(lambda _: self.show())
        self.lane.on_update(lambda _: self.show())
        self.last: np.ndarray | None = None
        self.show()
        self.stopped = threading.Event()
        self.thread = threading.Thread(target=self._play, daemon=True)
        self.thread.start()
        print(f"watch it at {self.address}")

    def _added(self, number: int, solid: Solid) -> Any:
        """A mesh on the server; what is stretched is sent anew at every time."""
        place = triangles(solid)[0] if solid.rigid else solid.corners[0]
        faces = np.arange(len(place)).reshape(-1, 3) if solid.rigid else _fans(solid)
        colour = tuple(int(255 * c) for c in solid.colour)
        name = f"/{solid.kind}s/{number} {solid.name.replace('/', ' ')}"
        return self.server.scene.add_mesh_simple(
            name, np.nan_to_num(place).astype(np.float32), faces.astype(np.uint32), color=colour,
            side="double", flat_shading=solid.kind != "body",
        )  # fmt: skip

    def show(self) -> None:
        """Move everything to the time of the slider."""
        number = min(int(self.lane.value), len(self.lanes)) - 1
        lane = self.lanes[number]
        k = int(np.abs(lane.t - lane.t[0] - self.now.value).argmin())
        with self.server.atomic():
            for handle, solid, turned in zip(self.moved, lane.solids, self.turned[number]):
                handle.visible = bool(np.isfinite(solid.rows[k]).all())
                if turned is not None and handle.visible:
                    handle.position, handle.wxyz = tuple(solid.rows[k, 0]), tuple(turned[k])
                elif handle.visible:
                    handle.vertices = (solid.rows[k, 0] + solid.points @ solid.rows[k, 1:]).astype(np.float32)
            for skin in lane.skins:
                self._skin(skin, k)
            for trace in lane.traces:
                if k:
                    ends = np.stack([trace.points[:k], trace.points[1 : k + 1]], axis=1)
                    self.server.scene.add_line_segments(f"/{trace.name}", ends, trace.colour)
        self._go_along(lane, k)

    def _skin(self, skin: Skin, k: int) -> None:
        import trimesh  # comes with viser

        corners = skin.points[k][skin.faces].reshape(-1, 3)
        four = 4 * np.arange(len(skin.faces))[:, None]
        faces = np.concatenate([four + (0, 1, 2), four + (0, 2, 3)])
        if skin.values is None:
            colours = np.tile(skin.colour, (len(skin.faces), 1))
        else:
            colours = along_map(skin.values[k], skin.values)
        mesh: Any = trimesh.Trimesh(corners, faces, process=False)
        mesh.visual.vertex_colors = (255 * np.repeat(colours, 4, axis=0)).astype(np.uint8)
        self.server.scene.add_mesh_trimesh(f"/surfaces/{skin.name.replace('/', ' ')}", mesh)

    def _go_along(self, lane: Scenery, k: int) -> None:
        """Move the cameras by as much as what they follow."""
        bodies = [s for s in lane.solids if s.kind == "body" and s.name == self.follow.value]
        places = [s.corners[k].mean(axis=0) for s in bodies]
        places += [s.points[k].mean(axis=0) for s in lane.skins if s.name == self.follow.value]
        here = places[0] if places else None
        if here is not None and self.last is not None:
            for client in self.server.get_clients().values():
                client.camera.position = client.camera.position + here - self.last
                client.camera.look_at = client.camera.look_at + here - self.last
        self.last = here

    def _play(self, rate: float = 30.0) -> None:
        """Play, again and again, until it is stopped."""
        while not self.stopped.wait(1.0 / rate):
            if self.playing.value:
                following = self.now.value + self.pace * self.speed.value / rate
                self.now.value = 0.0 if following > self.now.max else following

    def wait(self) -> None:
        """Stay until the program is interrupted: at the end of a script."""
        self.server.sleep_forever()

    def stop(self) -> None:
        """End it."""
        self.stopped.set()
        self.thread.join()
        self.server.stop()


def _fans(solid: Solid) -> np.ndarray:
    """Triangles of the faces of a mesh, by numbers of its corners."""
    return np.array([[f[0], f[j], f[j + 1]] for f in solid.faces for j in range(1, len(f) - 1)])
