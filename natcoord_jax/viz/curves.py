"""Panels of a trajectory: energies, balances, joint coordinates beside their rates, momenta, works."""

from collections.abc import Sequence

import numpy as np

from natcoord_jax.analysis.balance import balance
from natcoord_jax.core.state import Trajectory
from natcoord_jax.system import System
from natcoord_jax.viz.panels import Curve, Panel

AXES = "xyz"
MOST_STORES = 6
"""More stores of energy than this are summed by kind."""
ROUND_OFF = 1e-17
"""Errors below it are drawn as if they were as large, on the logarithmic scale."""
SMALL, LARGE = 1e-13, 1e-5
"""Errors that are round-off, and the least end of the scale, so that these are seen to be small."""
KEPT = 1e-9
"""A momentum that changes by less than this share of its size is kept: its error is drawn, not its value."""


def components(label: str, t: np.ndarray, vectors: np.ndarray) -> list[Curve]:
    """Three curves, one for each axis."""
    return [Curve(f"{label}{AXES[k]}", t, vectors[:, k]) for k in range(3)]


def _stores(system: System, trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Stored energies by name, or by kind of effect if there are many."""
    stores = {name: np.asarray(values) for name, values in system.energy(trajectory).stores.items()}
    if len(stores) <= MOST_STORES:
        return stores
    kinds: dict[str, np.ndarray] = {}
    for group in system.effects:
        for name in group.labels:
            if name in stores:
                kind = group.effect.kind
                kinds[kind] = kinds.get(kind, 0.0) + stores[name]
    return kinds


def _energies(system: System, trajectory: Trajectory, t: np.ndarray) -> Panel:
    energy, work = system.energy(trajectory), system.work(trajectory)
    curves = [Curve("kinetic", t, np.asarray(energy.kinetic))]
    curves += [Curve(name, t, values) for name, values in _stores(system, trajectory).items()]
    if energy.stores:
        curves.append(Curve("total", t, np.asarray(energy.total), dashed=True))
    if work:
        total = np.sum([np.asarray(w) for w in work.values()], axis=0)
        curves.append(Curve("work", t, total, dashed=True))
    return Panel("energy by store", "[J]", curves)


def _errors(system: System, trajectory: Trajectory, t: np.ndarray) -> Panel:
    """What ought to be zero, relative to fixed scales: balances and constraints."""
    found, violated = balance(system, trajectory), system.constraint_errors(trajectory)
    kept = [
        ("energy less work", found.energy),
        (
            f"momentum ({found.directions} {'direction' if found.directions == 1 else 'directions'})",
            found.momentum,
        ),
        (f"angular momentum ({found.axes} {'axis' if found.axes == 1 else 'axes'})", found.angular_momentum),
        ("constraints [m, -]", violated.position),
        ("their rates [m/s, 1/s]", violated.velocity),
    ]
    known = [(name, np.maximum.accumulate(np.asarray(x))) for name, x in kept if x is not None]
    curves = [Curve(name, t, np.maximum(values, ROUND_OFF)) for name, values in known]
    limits = ROUND_OFF, max([10 * float(np.max(c.values)) for c in curves] + [LARGE])
    title = "relative errors of what is kept, largest so far"
    return Panel(title, "[-]", curves, logarithmic=True, limits=limits, shaded=(ROUND_OFF, SMALL))


def coordinates(system: System, trajectory: Trajectory, t: np.ndarray) -> list[Panel]:
    """Joint angles and displacements, each beside their rates."""
    values, names = np.asarray(trajectory.states.coordinates), system.structure.coordinates
    units = {int(i): group.axis.unit for group in system.coordinates for i in np.asarray(group.index)}
    joints = dict.fromkeys(name for name, _ in names)
    rates = {name: np.asarray(system.sense(trajectory, name).rates) for name in joints}
    panels = []
    for title, speeds, unit in (
        ("joint angles", "joint rates", "rad"),
        ("joint displacements", "joint speeds", "m"),
    ):
        mine = [(i, name, k) for i, (name, k) in enumerate(names) if units[i] == unit]
        labels = [name if k == 0 else f"{name} [{k}]" for _, name, k in mine]
        if mine:
            at = [Curve(label, t, values[:, i]) for label, (i, _, _) in zip(labels, mine)]
            moving = [Curve(label, t, rates[name][:, k]) for label, (_, name, k) in zip(labels, mine)]
            panels += [Panel(title, f"[{unit}]", at), Panel(speeds, f"[{unit}/s]", moving)]
    return panels


def _momenta(system: System, trajectory: Trajectory, t: np.ndarray) -> list[Panel]:
    """Momenta that change: those that are kept are among the errors."""
    found = []
    for title, label, unit, values in (
        ("momentum", "L", "kg m/s", system.momentum(trajectory)),
        ("angular momentum about the origin", "J", "kg m²/s", system.angular_momentum(trajectory)),
    ):
        values = np.asarray(values)
        size = float(np.abs(values).max())
        # Of a body at rest there is round-off of nothing.
        if np.ptp(values, axis=0).max() > KEPT * max(size, 1e-6 * _size(system, trajectory)):
            found.append(Panel(title, f"{label} [{unit}]", components(label, t, values)))
    return found


def _size(system: System, trajectory: Trajectory) -> float:
    """About how large momenta are in this motion."""
    mass = float(np.asarray(system.mass)[:, 0, 0].sum())
    return float(np.sqrt(2 * mass * np.asarray(system.energy(trajectory).kinetic).max()))


def panels_of(system: System, trajectory: Trajectory) -> list[Panel]:
    """What is drawn of one trajectory."""
    t = np.asarray(trajectory.t)
    panels = [
        _energies(system, trajectory, t),
        _errors(system, trajectory, t),
        *coordinates(system, trajectory, t),
        *_momenta(system, trajectory, t),
    ]
    work = system.work(trajectory)
    if work:
        curves = [Curve(name, t, np.asarray(values)) for name, values in work.items()]
        panels.append(Panel("work of inputs, loads, dampers, drives", "[J]", curves))
    return panels


def in_turn(phases: Sequence[list[Panel]]) -> list[Panel]:
    """Panels with the curves of all phases one after the other, joined by title and label."""
    panels: dict[str, Panel] = {}
    for panel in (panel for phase in phases for panel in phase):
        known = panels.setdefault(panel.title, panel._replace(curves=[]))
        for curve in panel.curves:
            same = [k for k, other in enumerate(known.curves) if other.label == curve.label]
            if same:
                before = known.curves[same[0]]
                t, values = (np.concatenate(x) for x in zip(before[1:3], curve[1:3]))
                known.curves[same[0]] = before._replace(t=t, values=values)
            else:
                known.curves.append(curve)
    return list(panels.values())


def as_bands(runs: Sequence[list[Panel]]) -> list[Panel]:
    """Panels of the runs of a batch as one: the median, and the band between the least and the largest.

    At the times of the run that ends last: runs may differ in their steps and ends, and count until theirs.
    """
    panels: dict[str, dict[str, list[Curve]]] = {}
    first = {panel.title: panel for run in reversed(runs) for panel in run}
    for panel in (panel for run in runs for panel in run):
        for curve in panel.curves:
            panels.setdefault(panel.title, {}).setdefault(curve.label, []).append(curve)
    found = []
    for title, curves in panels.items():
        bands = []
        for same in curves.values():
            t = max((curve.t for curve in same), key=lambda t: t[-1])
            there = [t <= c.t[-1] + 1e-9 * (1 + np.abs(t)) for c in same]
            values = [np.where(ok, np.interp(t, c.t, c.values), np.nan) for ok, c in zip(there, same)]
            middle, band = (
                np.nanmedian(values, axis=0),
                (np.nanmin(values, axis=0), np.nanmax(values, axis=0)),
            )
            bands.append(same[0]._replace(t=t, values=middle, band=band))
        found.append(first[title]._replace(curves=bands))
    return found
