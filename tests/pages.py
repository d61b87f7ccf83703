"""What is in a file of `nc.view`, read as its player reads it."""

import base64
import dataclasses
import json
import re
import zlib
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

import natcoord_jax as nc

MISSING = -32768


def still(system: nc.System, state: nc.State) -> nc.Trajectory:
    """A motion in which nothing moves for a second: a picture without a run."""
    states = jax.tree.map(lambda x: np.stack([x, x]), state)
    states = dataclasses.replace(states, t=states.t + [0.0, 1.0])
    count = np.zeros((), int)
    return nc.Trajectory(
        states,
        inputs=np.zeros((1, len(system.structure.inputs))),
        result=count,
        failed_step=count + 1,
        failed_time=np.ones(()),
        failed_part=count - 1,
        residual=np.zeros(()),
        steps_taken=count + 1,
        steps_rejected=count,
        iterations=count,
        iterations_max=count,
    )


class Part(NamedTuple):
    """What moves with a frame.

    Attributes:
        name: of the body, joint, spring or force.
        kind: "body", "arm", "joint", "link" or "force".
        rows: origin and three vectors of its frame (lanes, t, 4, 3).
        step: of the numbers in them, to which they are rounded.
        place: corners of its triangles in that frame (n, 3).
        normal: of the surface there (n, 3).
        shade: brightness there (n,).
        lines: ends of the edges that are drawn (m, 3).
    """

    name: str
    kind: str
    rows: NDArray
    step: float
    place: NDArray
    normal: NDArray
    shade: NDArray
    lines: NDArray

    @property
    def corners(self) -> NDArray:
        """Where they are in the world (lanes, t, n, 3)."""
        return self.rows[:, :, :1] + self.place @ self.rows[:, :, 1:]


class Skin(NamedTuple):
    """A surface that changes its shape: corners (lanes, t, n, 3), faces (k, 4), values of these, a label."""

    name: str
    points: NDArray
    faces: NDArray
    values: NDArray | None
    label: str


class Page:
    """The description in a file, and the motion in it."""

    def __init__(self, file: Path):
        self.text = Path(file).read_text("utf-8")
        self.scene = json.loads(re.search(r"^const scene = (.*), packed = ", self.text, re.MULTILINE)[1])
        packed = re.search(r'packed = "([^"]*)"', self.text)[1]
        self.bytes = zlib.decompress(base64.b64decode(packed))

    def numbers(self, ref: dict) -> NDArray:
        """Multiples of a step, and differences along time."""
        values = np.frombuffer(self.bytes, np.int16, ref["count"], ref["at"])
        if ref["stride"]:
            values = np.cumsum(values.reshape(-1, ref["stride"]), axis=0, dtype=np.int16)
        values = values.reshape(-1)
        return np.where(values == MISSING, np.nan, ref["least"] + ref["step"] * values.astype(float))

    @property
    def lanes(self) -> int:
        return self.scene["lanes"]

    def parts(self, kind: str) -> list[Part]:
        """Of a kind, in the order they are listed."""
        return [self._part(solid) for solid in self.scene["solids"] if solid["kind"] == kind]

    def part(self, name: str, kind: str = "body") -> Part:
        """The only one with this name."""
        [part] = [part for part in self.parts(kind) if part.name == name]
        return part

    def _part(self, solid: dict) -> Part:
        mesh = {name: self.numbers(ref) for name, ref in self.scene["meshes"][solid["mesh"]].items()}
        return Part(
            solid["name"],
            solid["kind"],
            self.numbers(solid["rows"]).reshape(self.lanes, -1, 4, 3),
            solid["rows"]["step"],
            mesh["place"].reshape(-1, 3),
            mesh["normal"].reshape(-1, 3),
            mesh["shade"],
            mesh["lines"].reshape(-1, 3),
        )

    @property
    def skins(self) -> list[Skin]:
        return [self._skin(skin) for skin in self.scene["skins"]]

    def _skin(self, skin: dict) -> Skin:
        faces = np.frombuffer(self.bytes, np.int32, skin["faces"]["count"], skin["faces"]["at"]).reshape(
            -1, 4
        )
        values = skin["values"] and self.numbers(skin["values"]).reshape(self.lanes, -1, len(faces))
        points = self.numbers(skin["points"]).reshape(self.lanes, -1, skin["size"] // 3, 3)
        return Skin(skin["name"], points, faces, values, skin["label"])
