"""What a file says and a robot does not do, or does otherwise: by name, with the reason."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple


class Note(NamedTuple):
    """One thing that is not as the file has it.

    Attributes:
        part: what it is about, by name.
        reason: why, and what is done instead.
        mapped: whether the part is there, only otherwise; False: it is left out.
    """

    part: str
    reason: str
    mapped: bool = False


class Notes:
    """A list of notes to which reading adds; parts with the same reason become one line."""

    def __init__(self) -> None:
        self.found: dict[tuple[str, bool], list[str]] = {}

    def left_out(self, part: str, reason: str) -> None:
        """The part is not in the robot."""
        self._add(part, reason, False)

    def changed(self, part: str, reason: str) -> None:
        """The part is in the robot, otherwise than the file has it."""
        self._add(part, reason, True)

    def _add(self, part: str, reason: str, mapped: bool) -> None:
        parts = self.found.setdefault((reason, mapped), [])
        if part not in parts:
            parts.append(part)

    def listed(self) -> tuple[Note, ...]:
        """All of them, in the order in which they came."""
        return tuple(Note(part, *key) for key, parts in self.found.items() for part in parts)


def in_words(notes: tuple[Note, ...], mapped: bool) -> list[str]:
    """Lines for `print`, parts with the same reason together."""
    together: dict[str, list[str]] = {}
    for note in notes:
        if note.mapped == mapped:
            together.setdefault(note.reason, []).append(note.part)
    return [f"{', '.join(parts)}: {reason}" for reason, parts in together.items()]


@contextmanager
def warnings_noted(notes: Notes) -> Iterator[None]:
    """While it lasts, what MuJoCo warns of becomes a note, instead of a file in the folder of the user."""
    package = mujoco()
    before = package.get_mju_user_warning()
    package.set_mju_user_warning(lambda said: notes.left_out("MuJoCo warns", " ".join(said.split())))
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            yield
    finally:
        package.set_mju_user_warning(before)
    for warning in said:
        notes.changed("MuJoCo warns", " ".join(str(warning.message).split()))


def mujoco() -> Any:
    """MuJoCo's package, whose parser reads both formats.

    Raises:
        ImportError: with the line that installs it.
    """
    try:
        import mujoco as package
    except ImportError as error:
        raise ImportError(
            'nc.io reads URDF and MJCF with MuJoCo\'s parser: python -m pip install "natcoord-jax[io]"'
        ) from error
    return package
