"""Save and load: a structure in words and its arrays, in one file.

The file is a zip archive: `structure.json`, and the arrays in NumPy's format, as `numpy.load` reads them.

A system is saved as it was compiled, with the numbers that `System.set` has put in, and not by the parts of
its scene: these are not known to it any more, and compiling them again could give another order of unknowns
with another version, and bits that differ. What a version changes in the classes of a system is seen by the
fields that they have, and the file is refused.
"""

import io
import json
import os
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import Anything, of
from natcoord_jax.storage.described import Description, DescriptionError, check_fields, made

FORMAT = 1
"""Of the file; another number is another meaning of what is in it."""

STRUCTURE = "structure.json"
PATH = of("the name of a file, or its path", str, os.PathLike)


@checked(path=PATH, x=Anything())
def save(path: str | os.PathLike, x: Any) -> None:
    """Save a system, a state, a trajectory, a problem, a solution, or a container of them.

    What is saved is data: numbers, and the names of the classes that they are fields of. Effects, laws and
    costs of one's own are named by module and name, and looked up there when they are loaded: they have to be
    at the top of a module that can be imported, a lambda cannot be saved. No code is stored.

    Args:
        path: of the file, which is replaced at once when all is written; for instance "arm.nc".
        x: any of them, or other data classes and modules, in tuples, lists and dictionaries.

    Raises:
        ValueError: for what is no data, or cannot be found again by its name.

    Example:
        >>> import jax, os, tempfile; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), name="ball"))
        >>> path = os.path.join(tempfile.mkdtemp(), "ball.nc")
        >>> nc.save(path, scene.compile())
        >>> system, state = nc.load(path)
        >>> system.structure.bodies, state.q.shape
        (('ball',), (4, 3))
    """
    description = Description()
    try:
        what = description.of(x)
    except DescriptionError as error:
        raise ValueError(f"save: {error}") from error
    head = {
        "format": FORMAT,
        "natcoord_jax": version("natcoord_jax"),
        "fields": description.fields,
        "what": what,
    }
    path = Path(path)
    part = path.with_name(path.name + ".part")
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(STRUCTURE, json.dumps(head, allow_nan=False))
        for number, array in enumerate(description.arrays):
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asanyarray(array, order="C"), allow_pickle=False)
            file.writestr(f"{number}.npy", content.getvalue())
    os.replace(part, path)


@checked(path=PATH)
def load(path: str | os.PathLike) -> Any:
    """Load what `nc.save` has saved, or the trajectory that `nc.simulate(..., store=path)` has stored.

    Args:
        path: of the file.

    Returns:
        The same structure with the same numbers: programs that are compiled for one serve the other, and
        results are equal to the bit. A stored trajectory is read from the file where it is used.

    Raises:
        ValueError: for a file of something else, of another format, or whose classes have other fields in
            this version, with the reason.
        FileNotFoundError: if there is no file.
    """
    from natcoord_jax.storage.stream import SIGNATURE, stored

    path = Path(path)
    with path.open("rb") as file:
        begins = file.read(len(SIGNATURE))
    if begins == SIGNATURE:
        return stored(path)
    if not zipfile.is_zipfile(path):
        raise ValueError(f"load: {path} is no file of nc.save or of nc.simulate(..., store=...)")
    with zipfile.ZipFile(path) as file:
        if STRUCTURE not in file.namelist():
            raise ValueError(f"load: {path} is no file of nc.save: it has no {STRUCTURE}")
        head = json.loads(file.read(STRUCTURE))
        count = sum(name.endswith(".npy") for name in file.namelist())
        arrays = [
            np.lib.format.read_array(io.BytesIO(file.read(f"{k}.npy")), allow_pickle=False)
            for k in range(count)
        ]
    return understood(head, arrays, path)


def understood(head: dict[str, Any], arrays: list[np.ndarray], path: Path) -> Any:
    """What a head describes.

    Raises:
        ValueError: if it does not fit this version.
    """
    if head["format"] != FORMAT:
        raise ValueError(
            f"load: {path} has format {head['format']}, this version reads format {FORMAT}; it was written "
            f"by natcoord_jax {head['natcoord_jax']}, load it with that and save it anew"
        )
    try:
        check_fields(head["fields"])
        return made(head["what"], arrays)
    except DescriptionError as error:
        writer = head["natcoord_jax"]
        raise ValueError(f"load: {path}, written by natcoord_jax {writer}, does not fit: {error}") from error
