"""From a path, a text or a specification to MuJoCo's compiled model."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from natcoord_jax.io import masses, urdf
from natcoord_jax.io.notes import Notes, mujoco, warnings_noted

SUFFIXES = (".urdf", ".xml", ".mjcf")
WEIGHTLESS = "; give it a mass [kg] and an inertia [kg m^2], by an inertial element or by shapes that weigh"
"""What to do about a body that moves and has none."""


@dataclass
class Source:
    """What was read.

    Attributes:
        model: compiled, the single source of all numbers.
        notes: on what is not as the file has it.
        massless: links between joints that have no mass.
        velocities: limits of the rates of joints [rad/s or m/s], by name.
        is_urdf: whether it was URDF.
    """

    model: Any
    notes: Notes
    massless: set[str] = field(default_factory=set)
    velocities: dict[str, float] = field(default_factory=dict)
    is_urdf: bool = False


def read(source: Any, *, visuals: bool, floating: bool) -> Source:
    """Read and compile.

    Raises:
        ValueError: for something else than a path, a text or a specification, or what MuJoCo refuses.
        FileNotFoundError: for a path where nothing is.
    """
    notes = Notes()
    with warnings_noted(notes):
        return _read(source, notes, visuals, floating)


def _read(source: Any, notes: Notes, visuals: bool, floating: bool) -> Source:
    package = mujoco()
    if isinstance(source, package.MjSpec):
        return _finished(source.copy(), notes)
    if not isinstance(source, str | Path):
        raise ValueError(
            f"nc.io.load: source is an object of type {type(source).__name__}; pass the path of a .urdf or "
            ".xml file, the text of one, or a mujoco.MjSpec"
        )
    is_text = isinstance(source, str) and source.lstrip("\ufeff \n\r\t").startswith("<")
    file = None if is_text else Path(source)
    if file is not None and not file.is_file():
        raise FileNotFoundError(f"nc.io.load: source: there is no file {str(file)!r}; pass another path")
    text = str(source) if file is None else file.read_text(encoding="utf-8")
    root = urdf.parsed(text.lstrip("\ufeff \n\r\t"))
    if root.tag == "robot":
        return _from_urdf(text, root, file, notes, visuals, floating)
    if root.tag != "mujoco":
        raise ValueError(
            f"nc.io.load: source has the root <{root.tag}>; pass URDF (<robot>) or MJCF (<mujoco>)"
        )
    if floating:
        raise ValueError("nc.io.load: floating is for URDF, which cannot say it; in MJCF add a <freejoint/>")
    parser = package.MjSpec
    spec = _parsed(lambda: parser.from_string(text) if file is None else parser.from_file(str(file)))
    return _finished(spec, notes)


def _from_urdf(
    text: str, root: Any, file: Path | None, notes: Notes, visuals: bool, floating: bool
) -> Source:
    folder = None if file is None else file.resolve().parent
    ready = urdf.prepared(text.lstrip("\ufeff \n\r\t"), folder, notes, visuals=visuals, floating=floating)
    spec = _parsed(lambda: mujoco().MjSpec.from_string(ready))
    light: set[str] = set()
    if root.find("link/inertial") is not None:
        light = masses.settle(spec, notes)
        for mesh in spec.meshes:
            # Meshes are only seen here; a solid needs a volume, which flat ones have not.
            mesh.inertia = mujoco().mjtMeshInertia.mjMESH_INERTIA_SHELL
    found = _finished(spec, notes)
    found.massless, found.velocities, found.is_urdf = light, urdf.velocity_limits(root), True
    urdf.note_crossed_limits(root, notes)
    pairs = zip(found.model.eq_obj1id, found.model.eq_type)
    names = {found.model.joint(i).name for i, kind in pairs if kind == mujoco().mjtEq.mjEQ_JOINT}
    for name in urdf.mimics(root):
        if name not in names:
            notes.left_out(f"mimic of {name}", "one of the two joints does not turn or slide")
    return found


def _parsed(parse: Any) -> Any:
    try:
        return parse()
    except ValueError as error:
        raise ValueError(f"nc.io.load: MuJoCo does not read it: {' '.join(str(error).split())}") from None


def _finished(spec: Any, notes: Notes) -> Source:
    """Without what has no file, compiled."""
    _without_missing(spec, notes)
    spec.compiler.balanceinertia = True
    while True:
        try:
            model = spec.compile()
            break
        except ValueError as error:
            said = " ".join(str(error).split())
            spoilt = [m for m in spec.meshes if m.file and Path(m.file).name in said]
            if not spoilt:
                remedy = WEIGHTLESS if "mass and inertia" in said else ""
                raise ValueError(f"nc.io.load: MuJoCo does not compile it: {said}{remedy}") from None
            reason = said.partition(" in STL file")[0].partition(" Element name")[0]
            _without_mesh(spec, spoilt[0], f"MuJoCo does not read the mesh ({reason})", notes)
    masses.balanced(spec, model, notes)
    return Source(model, notes)


def _without_mesh(spec: Any, mesh: Any, reason: str, notes: Notes) -> None:
    """Leave out a mesh and what is made of it."""
    # Masses are those of inertial elements only.
    weightless = spec.compiler.inertiafromgeom == mujoco().mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    for geom in [g for g in spec.geoms if g.meshname == mesh.name]:
        weighs = not geom.parent.explicitinertial and not weightless
        notes.left_out(mesh.file, f"{reason}; it is not drawn" + (", and its mass is missing" * weighs))
        spec.delete(geom)
    spec.delete(mesh)


def _without_missing(spec: Any, notes: Notes) -> None:
    """Leave out meshes, height fields and textures whose files are not there, and what is made of them."""
    folder, settings = Path(spec.modelfiledir or "."), spec.compiler
    for mesh in list(spec.meshes):
        file = folder / settings.meshdir / mesh.file
        if mesh.file and mesh.file not in spec.assets and not file.is_file():
            _without_mesh(spec, mesh, "the mesh file is not there", notes)
    for texture in list(spec.textures):
        names = [texture.file, *texture.cubefiles]
        lost = [n for n in names if n and not (folder / settings.texturedir / n).is_file()]
        if lost:
            notes.left_out(lost[0], "the texture file is not there")
            spec.delete(texture)
