"""Pictures. matplotlib is imported here and nowhere else, and only when this package is."""

from natcoord_jax.viz.animate import animate
from natcoord_jax.viz.panels import Curve, Panel, plot_panels
from natcoord_jax.viz.plot import plot, plot_snapshots
from natcoord_jax.viz.views import View, view

__all__ = ["Curve", "Panel", "View", "animate", "plot", "plot_panels", "plot_snapshots", "view"]
