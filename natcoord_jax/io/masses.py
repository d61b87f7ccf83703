"""Inertias that MuJoCo's compiler would refuse: balanced by its own rule, or absent, and listed."""

from typing import Any

import numpy as np

from natcoord_jax.io.notes import Notes, mujoco

FEATHER = 2e-15
"""Mass [kg] and inertia [kg m^2] that MuJoCo's compiler takes for a link without any: it refuses 1e-15."""


def tensor(full: np.ndarray) -> np.ndarray:
    """Inertia tensor (3, 3) of (xx, yy, zz, xy, xz, yz)."""
    xx, yy, zz, xy, xz, yz = full
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def settle(spec: Any, notes: Notes) -> set[str]:
    """Make the inertias of a URDF such that they can be compiled.

    Returns:
        Names of the links that have no mass, between joints; MuJoCo gets a feather for each.

    Raises:
        ValueError: for a negative mass.
    """
    for body in spec.bodies[1:]:
        if body.mass < 0:
            raise ValueError(
                f"nc.io.load: link {body.name!r}: mass [kg] is {body.mass:g}; give it a positive one, or no "
                "inertial element"
            )
        _settle_tensor(body, notes)
    light = set()
    for body in spec.bodies[1:]:
        if not len(body.joints):
            continue
        if sum(b.mass for b in _subtree(body)) <= 0:
            for joint in list(body.joints):
                notes.left_out(joint.name, f"it moves no mass, and is fixed: all that carries is {body.name}")
                for equality in list(spec.equalities):
                    if joint.name in (equality.name1, equality.name2):
                        spec.delete(equality)
                spec.delete(joint)
            continue
        carried = _rigid(body)
        if sum(b.mass for b in carried) <= 0:
            body.mass, body.ipos, light = FEATHER, np.zeros(3), light | {body.name}
            body.explicitinertial = True
        if all(np.isnan(b.fullinertia[0]) and min(b.inertia) < FEATHER for b in carried):
            if body.name not in light and max(max(b.inertia) for b in carried) < FEATHER:
                notes.changed(body.name, "it has mass and no inertia, and is a point mass")
            body.inertia = np.maximum(body.inertia, FEATHER)
    return light


def _settle_tensor(body: Any, notes: Notes) -> None:
    """An inertia that is no positive tensor: MuJoCo refuses it, and balances only what is one."""
    full = np.array(body.fullinertia)
    if np.isnan(full[0]):
        return
    values, axes = np.linalg.eigh(tensor(full))
    if values[0] > 1e-14:
        return
    body.fullinertia = np.array([np.nan, 0, 0, 0, 0, 0])
    if values[0] >= -1e-9 * values[2]:
        if np.linalg.det(axes) < 0:
            axes = -axes
        body.inertia, turned = np.maximum(values, 0.0), np.zeros(4)
        mujoco().mju_mat2Quat(turned, axes.ravel())
        body.iquat = turned
        return
    mean = max(float(np.mean(values)), 0.0)
    body.inertia, body.iquat = np.full(3, mean), np.array([1.0, 0, 0, 0])
    notes.changed(
        body.name,
        f"no body has the principal inertias {np.array2string(values, precision=3)} kg m^2; as MuJoCo "
        f"balances, all three are their mean, {mean:.3g}",
    )


def _rigid(body: Any) -> list[Any]:
    """A body and those fixed to it."""
    return [body, *(b for child in body.bodies if not len(child.joints) for b in _rigid(child))]


def _subtree(body: Any) -> list[Any]:
    """A body and all that it carries."""
    return [body, *(b for child in body.bodies for b in _subtree(child))]


def balanced(spec: Any, model: Any, notes: Notes) -> None:
    """List what the compiler has balanced: principal inertias of which one exceeds the sum of the others."""
    if spec.compiler.settotalmass > 0:
        return
    for body in spec.bodies[1:]:
        full = np.array(body.fullinertia)
        if not body.explicitinertial:
            continue
        given = np.array(body.inertia) if np.isnan(full[0]) else np.linalg.eigvalsh(tensor(full))
        given, taken = np.sort(given), np.sort(model.body_inertia[body.id])
        if np.max(np.abs(given - taken)) > 1e-9 * np.max(np.abs(taken), initial=FEATHER):
            notes.changed(
                body.name or f"body {body.id}",
                f"no body has the principal inertias {np.array2string(given, precision=3)} kg m^2; as MuJoCo "
                f"balances, they are {np.array2string(taken, precision=3)}",
            )
