"""Draw the house: the floors of the package, from the ground up, as its sources have them.

`python docs/house.py` writes `docs/house.svg`: a bar for the lines of each floor, and what it is for.
"""

import ast
import sys
from pathlib import Path

import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "natcoord_jax"
sys.path.insert(0, str(ROOT / "tests"))

from test_floors import FLOORS  # noqa: E402

COLOURS = {"engine": "#3b6ea5", "parts": "#7aa66b", "people": "#c98f4e"}
KINDS = {
    "engine": ("xla", "maths", "linsolve", "core", "model", "mechanics", "stepping"),
    "parts": ("mesh", "effects", "bodies", "scene", "build", "system", "reading"),
}


def floor(name: str) -> tuple[int, str]:
    """Lines of a floor, and the first line of what it says of itself."""
    folder = PACKAGE / name
    files = sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]
    head = folder / "__init__.py" if folder.is_dir() else files[0]
    said = (ast.get_docstring(ast.parse(head.read_text("utf-8"))) or "").splitlines()[0]
    return sum(file.read_text("utf-8").count("\n") for file in files), said


def main() -> None:
    """Write the picture."""
    figure, axes = plt.subplots(figsize=(11, 6.6), layout="constrained")
    for height, name in enumerate(FLOORS):
        lines, said = floor(name)
        kind = next((kind for kind, names in KINDS.items() if name in names), "people")
        axes.barh(height, lines, color=COLOURS[kind], height=0.8)
        axes.text(-120, height, name, ha="right", va="center", family="monospace", fontsize=9)
        axes.text(lines + 80, height, said, ha="left", va="center", fontsize=8)
    axes.set(xlim=(-900, 16000), xlabel="lines; a floor imports from those below it only", yticks=[])
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.set_xticks(range(0, 8001, 2000))
    figure.savefig(ROOT / "docs" / "house.svg", metadata={"Date": None, "Creator": None})


if __name__ == "__main__":
    main()
