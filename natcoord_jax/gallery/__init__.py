"""The gallery: ready scenes for the command line, tests, benchmarks and notebooks.

Every entry of `SCENES` is a function without obligatory arguments that builds an `Example`; the first line
of its docstring says what it is.
"""

from collections.abc import Callable, Mapping

from natcoord_jax.gallery.example import Example as Example
from natcoord_jax.gallery.spacecraft import spacecraft as spacecraft

SCENES: Mapping[str, Callable[[], Example]] = {
    "spacecraft": spacecraft,
}


def describe(name: str) -> str:
    """What a scene is, in one line."""
    return (SCENES[name].__doc__ or "").partition("\n")[0]


def load(name: str) -> Example:
    """Build a scene by name.

    Raises:
        ValueError: for a name that is not in the gallery.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> from natcoord_jax import gallery
        >>> gallery.load("spacecraft").system.structure.unknowns
        9
    """
    if name not in SCENES:
        raise ValueError(f"the gallery has no scene {name!r}; it has {', '.join(SCENES)}")
    return SCENES[name]()
