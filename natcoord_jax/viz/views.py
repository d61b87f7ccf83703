"""A view of a motion in three dimensions, to be turned and played: in a notebook, a browser, a file.

The view is one file of HTML with its own small player, some kilobytes of script. The embedded recordings of
viser, which draws the live view, were measured against it: 0.8 MB before a single body is in them, so that a
notebook with two is beyond 1 MB, and neither a camera that follows nor a slider of runs nor a colour scale.
"""

import html
import os
import sys
import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from natcoord_jax.analysis.phases import Phases
from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.control.solution import Solution
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import FLAG, NAME, Concrete, HandleOf, of
from natcoord_jax.core.markers import Marker
from natcoord_jax.core.state import TRAJECTORY, Trajectory
from natcoord_jax.system import System
from natcoord_jax.viz.animate import POINTS, pace_of
from natcoord_jax.viz.motion import (
    BEAMS,
    BOX,
    COLOURS,
    MOVING,
    even_times,
    lanes_of,
    longest_of,
    runs_of,
    scenery_at,
)
from natcoord_jax.viz.packed import bytes_of_a_picture, page
from natcoord_jax.viz.scenery import Scenery, matched
from natcoord_jax.viz.skins import Colouring

LIMIT = 2_900_000
"""Most bytes of a file."""
MOST_PICTURES, FEWEST_PICTURES = 600, 8


class View:
    """A view, which a notebook shows where it is returned.

    Attributes:
        html: the file's text.
    """

    def __init__(self, text: str, height: int = 520):
        self.html, self._height = text, height

    def _repr_html_(self) -> str:
        frame = f'width="100%" height="{self._height}" style="border: 0"'
        return f'<iframe {frame} srcdoc="{html.escape(self.html)}"></iframe>'

    def save(self, file: str | Path) -> Path:
        """Write it to a file."""
        Path(file).write_text(self.html, "utf-8")
        return Path(file)

    def __repr__(self) -> str:
        return f"<view of {len(self.html) / 1e6:.2f} MB; .save(file) writes it>"


def _sceneries(phases: Phases, count: int, options: Mapping[str, Any]) -> list[Scenery]:
    """What there is to draw, one of each run that is shown, at so many times."""
    runs = runs_of(phases)
    # Runs may differ in their ends: all are shown over the times of the longest, and rest at their own ends.
    times = even_times(longest_of(runs), count)
    return matched([scenery_at(run, times, **options)._replace(t=times) for run in runs])


def _page(phases: Phases, follow: str, pace: float, limit: int, options: Mapping[str, Any]) -> str:
    """The text of a view, with as many pictures as fit.

    Raises:
        ValueError: for a body to follow that there is not, or meshes that are too large.
    """
    first = _sceneries(phases, 1, options)
    if follow and follow not in first[0].bodies:
        names = ", ".join(first[0].bodies[:20])
        raise ValueError(f"view: there is no body {follow!r} to follow; there are {names}")
    each = len(first) * bytes_of_a_picture(first[0])
    count = int(np.clip(limit // (2 * max(each, 1)), FEWEST_PICTURES, MOST_PICTURES))
    while True:
        text = page(_sceneries(phases, count, options), pace, follow)
        if len(text.encode()) <= limit:
            return text
        if count <= FEWEST_PICTURES:
            raise ValueError(
                f"view: {len(text) / 1e6:.1f} MB with {count} pictures are more than {limit / 1e6:.1f} MB; "
                "pass fewer lanes, or live=True"
            )
        count = max(FEWEST_PICTURES, count // 2)


def _in_notebook() -> bool:
    """Whether this runs in the kernel of a notebook; to look must not load anything."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and "IPKernelApp" in shell.config


def _has_display() -> bool:
    return sys.platform in ("darwin", "win32") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


def open_file(file: Path) -> None:
    """Open a file in the browser where there is a display; else say where it is."""
    place = file.resolve()
    if _has_display() and webbrowser.open(place.as_uri()):
        print(f"opened {place}")
    else:
        print(f"open {place} in a browser")


@checked()
def view(
    system: Annotated[System | Phases | Solution, MOVING],
    trajectory: Annotated[Trajectory | None, Concrete(TRAJECTORY)] = None,
    *,
    file: Annotated[str | Path | None, of("the name of a file that ends in .html", str, Path)] = None,
    title: Annotated[str, NAME] = "",
    follow: Annotated[Handle | str, HandleOf("body") | NAME] = "",
    traces: Annotated[Sequence[Marker], POINTS] = (),
    colour: Annotated[Colouring, COLOURS] = "energy",
    beams: Annotated[Sequence[BeamHandle], BEAMS] = (),
    within: Annotated[Any, BOX] = None,
    live: Annotated[bool, FLAG] = False,
) -> "View | Path | Any":
    """A motion in three dimensions: turn it, play it, scrub it.

    Bodies have their shapes, or the plainest solid with their inertia, with arms to their joints; joints have
    their axes; springs are coils; loads and motors are red arrows, which turn where they are torques, normal
    forces of contacts green ones, of surfaces on their nodes; beams are swept with their section. There is a
    ground where there is gravity. In a notebook the view is shown where it is returned; from a script it is
    written to a file, which the browser opens if there is a display.

    Args:
        system: compiled system; or a motion in phases or a solution of an optimal control problem, which need
            no trajectory.
        trajectory: computed with it, of one lane or of a batch: then a slider chooses the run and the
            others are ghosts, 16 of them at most.
        file: where to write it, one .html below 3 MB that needs no network; None: see above.
        title: in its corner.
        follow: body that the camera moves along with.
        traces: points whose paths are drawn, `nc.Point(body, (x, y, z))`.
        colour: of beams, shells and solids: "energy", stored per length [J/m], area [J/m^2] or volume
            [J/m^3]; "parts"; or values of the elements by name, shape (elements,) or (saved, elements).
        beams: handles of beams, whose sections are drawn as given; the others are round.
        within: two corners of the box (2, 3) [m] that is looked into: what is outside is not drawn; None:
            all is seen.
        live: serve it by viser (the extra `viz3d`) instead, with no limit of size: for what runs on another
            machine. Of what is returned, `.wait()` stays until it is interrupted, `.stop()` ends it.

    Returns:
        A `View`; the path of the file; or what is served, with its `address`.

    Raises:
        ValueError: for no trajectory, another kind of file, a body that there is not, or meshes that do not
            fit into the file.
        ImportError: for `live` without viser.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(0.0, 0.1, 0.1), com=(0.5, 0, 0), name="arm"))
        >>> hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 1, 0)))
        >>> gravity = scene.add(nc.Gravity())
        >>> system, state = scene.compile()
        >>> trajectory = nc.simulate(system, state, dt=0.02, steps=50)
        >>> import pathlib, tempfile
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> nc.view(system, trajectory, file=folder / "motion.html", follow=arm).name
        'motion.html'
    """
    phases = lanes_of(system, trajectory, "view")
    if file is not None and Path(file).suffix.lower() != ".html":
        raise ValueError(f"view writes HTML, not {str(file)!r}; pass a name that ends in .html")
    name = follow if isinstance(follow, str) else follow.name
    bodies: Sequence[str] = phases.systems[0].structure.bodies
    options = {"beams": beams, "traces": traces, "colour": colour, "within": within}
    options["title"] = title or (f"{len(bodies)} bodies" if len(bodies) != 1 else bodies[0])
    pace = pace_of(longest_of(runs_of(phases)))
    if live:
        from natcoord_jax.viz.live import Live

        return Live(_sceneries(phases, MOST_PICTURES, options), pace, name)
    # A notebook stores what it shows, escaped once more.
    shown = file is None and _in_notebook()
    made = View(_page(phases, name, pace, LIMIT // 4 if shown else LIMIT, options))
    if file is not None:
        return made.save(file)
    if not shown:
        open_file(made.save(Path(tempfile.mkdtemp(prefix="natcoord_jax-")) / "motion.html"))
    return made
