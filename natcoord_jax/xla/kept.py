"""Programs that outlast the process."""

import hashlib
import os
import platform
import tempfile
import time
from functools import cache
from pathlib import Path

import jax
import jaxlib.version
from jax.experimental.compilation_cache import compilation_cache

FOLDER = "natcoord_jax"
"""Name of the folder in that for what can be made again."""

FULL = "full"
"""Name of the folder of programs that were compiled with full effort, beside those that JAX keeps itself."""

DIGEST = 32
"""Bytes of a file that tell whether the others are all there."""

MONTH = 30 * 24 * 3600.0
"""Age [s] at which a program is deleted: versions of JAX follow each other as fast."""


def keep(folder: str | os.PathLike | None, on: bool) -> Path | None:
    """Keep programs in a folder, or in that of this user; or none from now on."""
    user = _by_default() if folder is None else Path(folder)
    kind = user / processor()
    if on:
        kind.mkdir(parents=True, exist_ok=True)
        _tidied(kind)
    jax.config.update("jax_compilation_cache_dir", str(kind) if on else None)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    compilation_cache.reset_cache()  # JAX looks at the setting once, when it compiles its first program
    return user if on else None


def get(request: bytes) -> bytes | None:
    """What was put there for a request; None if there is nothing, or not all of it."""
    path = _path(request)
    try:
        content = b"" if path is None else path.read_bytes()
    except OSError:
        return None
    found, check = content[DIGEST:], content[:DIGEST]
    return found if found and hashlib.sha256(found).digest() == check else None


def put(request: bytes, found: bytes) -> None:
    """Keep it, if programs are kept, all at once: whoever reads meanwhile finds nothing."""
    path = _path(request)
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
            file.write(hashlib.sha256(found).digest() + found)
        os.replace(file.name, path)
    except OSError:  # (No room, or not ours to write: it is compiled again then.)
        return


def _path(request: bytes) -> Path | None:
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    # An environment variable that is set to nothing is not set.
    if not folder or "://" in folder:
        return None
    versions = jax.__version__, jaxlib.version.__version__, os.environ.get("XLA_FLAGS"), processor()
    return Path(folder) / FULL / hashlib.sha256(repr(versions).encode() + request).hexdigest()


@cache
def processor() -> str:
    """What tells kinds of processors apart: code for one may end another's process."""
    about = platform.machine() + platform.processor()
    known = Path("/proc/cpuinfo")
    if known.exists():
        lines = (x for x in known.read_text().splitlines() if x.startswith(("flags", "Features")))
        about += next(lines, "")
    return hashlib.sha256(about.encode()).hexdigest()[:16]


def _by_default() -> Path:
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / FOLDER / "programs"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / FOLDER


def _tidied(folder: Path) -> None:
    """Delete what is old."""
    oldest = time.time() - MONTH
    for path in [*folder.glob("*"), *(folder / FULL).glob("*")]:
        try:
            if path.is_file() and path.stat().st_mtime < oldest:
                path.unlink()
        except OSError:  # (Another process was faster.)
            continue
