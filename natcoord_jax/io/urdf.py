"""URDF text before MuJoCo's parser sees it: settings, paths of meshes, and what it would pass over."""

import os
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path
from xml.etree.ElementTree import Element
from xml.parsers import expat

from natcoord_jax.io.notes import Notes

READABLE = {".stl", ".obj", ".msh"}
"""Formats of meshes that MuJoCo reads."""

KNOWN = {"link", "joint", "material", "mujoco"}
PARTS = {
    "link": {"inertial", "visual", "collision"},
    "joint": {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "calibration"},
}
"""What is read of a file, of a link and of a joint; calibration says nothing of the motion."""


def prepared(text: str, folder: Path | None, notes: Notes, *, visuals: bool, floating: bool) -> str:
    """URDF in which nothing is lost on the way through the parser.

    By default the parser makes links that fixed joints join one body whose names are gone, drops what is only
    seen, looks for meshes by their last name, and gives links without an inertial element the mass of what
    is drawn of them; URDF says that they have none.

    Args:
        text: URDF.
        folder: where it lies, for the paths of meshes; None: unknown.
        notes: to which what is not read is added.
        visuals: keep what is drawn.
        floating: give the root link a free joint.

    Raises:
        ValueError: for text that is no XML.
    """
    root = parsed(text)
    weighed = root.find("link/inertial") is not None
    for link in root.iter("link"):
        _draw(link, folder, notes, visuals or not weighed)
    for old in root.findall("mujoco"):
        root.remove(old)
    options = {
        "fusestatic": "false",
        "discardvisual": "false",
        "strippath": "false",
        "balanceinertia": "true",
    }
    if weighed:
        options["inertiafromgeom"] = "false"
    else:
        notes.changed("all links", "none has an inertial element: they weigh what is drawn, at 1000 kg/m^3")
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", options)
    if floating:
        _float(root, notes)
    others = Counter(f"<{child.tag}>" for child in root if child.tag not in KNOWN)
    for kind, tags in PARTS.items():
        others.update(f"<{x.tag}>" for part in root.findall(kind) for x in part if x.tag not in tags)
    others.update(name for x in root.iter() for name in x.keys() if ":" in name and name[:5] != "xmlns")
    for extension, count in others.items():
        notes.left_out(f"{count} {extension}", "extensions of URDF are not read")
    return ElementTree.tostring(root, encoding="unicode")


def parsed(text: str) -> Element:
    """The root of a text. Names with a prefix stay as they are, whether or not it is declared.

    Raises:
        ValueError: for what is no XML, or a template of it.
    """
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise ValueError(f"nc.io.load: the text is no XML ({error}); pass URDF or MJCF") from None
    root = builder.close()
    if any(element.tag.startswith("xacro:") for element in root.iter()):
        raise ValueError("nc.io.load: the text is a template; expand it: xacro robot.xacro > robot.urdf")
    return root


def velocity_limits(root: Element) -> dict[str, float]:
    """Limits of the rates of joints [rad/s or m/s], which MuJoCo has no place for."""
    found = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if limit is not None and float(limit.get("velocity", "0")) > 0:
            found[joint.get("name", "")] = float(limit.get("velocity", "0"))
    return found


def note_crossed_limits(root: Element, notes: Notes) -> None:
    """Limits of which the lower is above the upper are none to MuJoCo, without a word."""
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if limit is None or joint.get("type") not in ("revolute", "prismatic"):
            continue
        lower, upper = (float(limit.get(end, "0")) for end in ("lower", "upper"))
        if lower > upper:
            reason = f"the lower one, {lower:g}, is above the upper one, {upper:g} [rad or m]"
            notes.left_out(f"the limits of {joint.get('name', '')}", reason)


def mimics(root: Element) -> list[str]:
    """Names of the joints that follow others."""
    return [joint.get("name", "") for joint in root.findall("joint") if joint.find("mimic") is not None]


def _float(root: Element, notes: Notes) -> None:
    """A link "world" above the root link, which a floating joint joins to it."""
    children = {child.get("link") for child in root.findall("joint/child")}
    tops = [link.get("name", "") for link in root.findall("link") if link.get("name") not in children]
    top = tops[0] if tops else ""
    if top in ("", "world"):
        notes.left_out(
            "floating", "the root link is called world, and that is the ground" if top else "there is no link"
        )
        return
    ElementTree.SubElement(root, "link", {"name": "world"})
    taken = {joint.get("name") for joint in root.findall("joint")}
    name = "root" if "root" not in taken else f"{top} free"
    joint = ElementTree.SubElement(root, "joint", {"name": name, "type": "floating"})
    ElementTree.SubElement(joint, "parent", {"link": "world"})
    ElementTree.SubElement(joint, "child", {"link": top})


def _draw(link: Element, folder: Path | None, notes: Notes, wanted: bool) -> None:
    """Keep of a link one set of shapes, those seen before those that collide, whose files are there."""
    kept = False
    for tag in ("visual", "collision"):
        for shape in link.findall(tag):
            if not wanted or (kept and tag == "collision") or not _found(shape, folder, notes):
                link.remove(shape)
        kept = kept or link.find(tag) is not None


def _found(shape: Element, folder: Path | None, notes: Notes) -> bool:
    """Whether the parser can read a shape; the path of a mesh becomes an absolute one."""
    mesh = shape.find("geometry/mesh")
    if mesh is None:
        return shape.find("geometry") is not None
    name = mesh.get("filename", "")
    file = resolve(name, folder)
    if file is None:
        notes.left_out(name, "the mesh file is not there; it is not drawn")
        return False
    if file.suffix.lower() not in READABLE:
        notes.left_out(name, f"meshes of format {file.suffix} are not read; it is not drawn")
        return False
    mesh.set("filename", str(file))
    return True


def resolve(name: str, folder: Path | None) -> Path | None:
    """The file behind a path of URDF; None: it is not there.

    That of "package://name/rest" is looked for below all folders above, and where ROS_PACKAGE_PATH says.
    """
    scheme, _, rest = name.rpartition("://")
    rest = rest if scheme else name
    if scheme == "file" or Path(rest).is_absolute():
        return Path(rest) if Path(rest).is_file() else None
    above = [] if folder is None else [folder, *folder.parents]
    roots = above + [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
    without = rest.partition("/")[2] if scheme == "package" else rest
    candidates = (root / part for root in roots for part in (rest, without))
    return next((file.resolve() for file in candidates if file.is_file()), None)
