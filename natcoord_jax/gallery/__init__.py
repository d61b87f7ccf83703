"""The gallery: ready scenes for the command line, tests, benchmarks and notebooks.

Every entry of `SCENES` is a function without obligatory arguments that builds an `Example`; the first line
of its docstring says what it is.
"""

from collections.abc import Callable, Mapping
from typing import Any

from natcoord_jax.gallery.contact import (
    bouncing_ball,
    colliding_blocks,
    dice,
    newton_cradle,
    rattleback,
    tumbling_capsules,
)
from natcoord_jax.gallery.continua import (
    cantilever,
    flying_plate,
    flying_spaghetti,
    inflated_ball,
    rope,
    solar_panels,
    tumbling_block,
)
from natcoord_jax.gallery.example import Example
from natcoord_jax.gallery.loops import bicycle, bricard, four_bar, slider_crank
from natcoord_jax.gallery.manoeuvres import reorientation_example
from natcoord_jax.gallery.panel_slew import panel_slew
from natcoord_jax.gallery.pendulums import (
    double_pendulum,
    dzhanibekov,
    fast_top,
    free_body,
    heavy_top,
    pendulum,
    torsion_spring,
)
from natcoord_jax.gallery.plugging import plugging
from natcoord_jax.gallery.robot import robot_cable
from natcoord_jax.gallery.spacecraft import spacecraft
from natcoord_jax.gallery.stiff import mass_ladder, stiff_chain
from natcoord_jax.gallery.tennis import tennis
from natcoord_jax.gallery.trees import binary_tree, chain, open_tree, robot_arm

SCENES: Mapping[str, Callable[..., Example]] = {
    "spacecraft": spacecraft,
    "reorientation": reorientation_example,
    "pendulum": pendulum,
    "double_pendulum": double_pendulum,
    "torsion_spring": torsion_spring,
    "heavy_top": heavy_top,
    "fast_top": fast_top,
    "free_body": free_body,
    "dzhanibekov": dzhanibekov,
    "four_bar": four_bar,
    "bricard": bricard,
    "slider_crank": slider_crank,
    "bicycle": bicycle,
    "open_tree": open_tree,
    "chain": chain,
    "binary_tree": binary_tree,
    "robot_arm": robot_arm,
    "stiff_chain": stiff_chain,
    "mass_ladder": mass_ladder,
    "rope": rope,
    "cantilever": cantilever,
    "flying_spaghetti": flying_spaghetti,
    "flying_plate": flying_plate,
    "tumbling_block": tumbling_block,
    "solar_panels": solar_panels,
    "panel_slew": panel_slew,
    "inflated_ball": inflated_ball,
    "bouncing_ball": bouncing_ball,
    "newton_cradle": newton_cradle,
    "tumbling_capsules": tumbling_capsules,
    "rattleback": rattleback,
    "dice": dice,
    "colliding_blocks": colliding_blocks,
    "robot_cable": robot_cable,
    "plugging": plugging,
    "tennis": tennis,
}

__all__ = ["SCENES", "Example", "describe", "load"]


def describe(name: str) -> str:
    """What a scene is, in one line."""
    return (SCENES[name].__doc__ or "").partition("\n")[0]


def load(name: str, **options: Any) -> Example:
    """Build a scene by name; `options` go to its function.

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
    return SCENES[name](**options)
