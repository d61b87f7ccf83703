"""Films of the pages on optimal control: runs their code and draws the motion found, small.

A page that draws something else has a function `draw` of the file.

python docs/films.py            all pages
python docs/films.py peak room  some of them
"""

import re
import sys
import tempfile
from pathlib import Path

from PIL import Image, ImageSequence

import natcoord_jax as nc

PAGES = Path(__file__).parent / "howto"
FRAMES, WIDTH, COLOURS = 30, 300, 32


def shrunk(film: Path, file: Path) -> None:
    """Some pictures of a film, smaller and in few colours."""
    with Image.open(film) as given:
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(given)]
        lasting = given.info.get("duration", 40) * len(frames)
    count = min(FRAMES, len(frames))
    kept = [frames[round(k * (len(frames) - 1) / (count - 1))] for k in range(count)]
    height = round(WIDTH * kept[0].height / kept[0].width)
    small = [x.resize((WIDTH, height), Image.Resampling.LANCZOS).quantize(COLOURS) for x in kept]
    file.parent.mkdir(exist_ok=True)
    pause = round(lasting / len(small))
    small[0].save(file, save_all=True, append_images=small[1:], duration=pause, loop=0, optimize=True)


def main() -> None:
    """Makes the films."""
    chosen = sys.argv[1:] or [page.stem.removeprefix("control_") for page in PAGES.glob("control_*.md")]
    for name in sorted(chosen):
        text = (PAGES / f"control_{name}.md").read_text("utf-8")
        names: dict = {"__name__": "page"}
        for block in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            exec(compile(block, name, "exec"), names)
        if "found" not in names:
            continue
        with tempfile.TemporaryDirectory() as folder:
            film = Path(folder) / "film.gif"
            if "draw" in names:
                names["draw"](film)
            else:
                nc.animate(names["found"], file=film, **names.get("film", {}))
            shrunk(film, PAGES / "films" / f"control_{name}.gif")
        print(name, (PAGES / "films" / f"control_{name}.gif").stat().st_size, "bytes")


if __name__ == "__main__":
    main()
