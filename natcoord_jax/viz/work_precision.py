"""What accuracy costs in time, as a figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from natcoord_jax.analysis.accuracy_table import Accuracy


def plot_accuracy(found: Accuracy) -> Figure:
    """Errors over time and over steps, one curve an order, on logarithmic scales."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), sharey=True, layout="constrained")
    for order in sorted({row.order for row in found.rows}):
        rows = [r for r in found.rows if r.order == order and r.result == "successful" and r.error > 0]
        errors = [r.error for r in rows]
        axes[0].loglog([1e3 * r.wall_s for r in rows], errors, "o-", markersize=4, label=f"order {order}")
        axes[1].loglog([r.steps for r in rows], errors, "o-", markersize=4, label=f"order {order}")
    quantity = next(iter(found.rows[0].errors)) if found.rows else ""
    for diagram, abscissa in zip(axes, ("time [ms], without compilation", "steps")):
        if found.reference_error > 0:
            diagram.axhline(found.reference_error, color="0.6", linestyle="--", linewidth=1)
        diagram.set(xlabel=abscissa)
        diagram.grid(alpha=0.3)
    axes[0].set(ylabel=f"error of {quantity} at t = {found.t_end:g} s", title="what accuracy costs")
    axes[1].set(title="orders; dashed: error of the reference")
    axes[0].legend(fontsize="small")
    return figure
