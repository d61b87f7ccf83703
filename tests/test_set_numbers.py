"""Every number of every part of the contract table, set in a compiled system: the motion hears it, or it is
refused."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import AXIS, SECOND, SPECIAL, with_multipliers
from test_contracts import TABLE, Parts

import natcoord_jax as nc

SOME = nc.Screw, nc.JointSpring, nc.Revolute
"""Of the slow lane."""

UNHEARD = {
    "overlaps": "mass, of a material without density",
    "volumes": "mass, of a material without density",
    "spherical damper 1: weights": "they only say which bodies turn",
    "skin": "how far contacts are searched",
    "point on point 1: weights": "it repeats what the joint holds",
    "hard contact 1: gap.radii": "the surfaces are apart",
    "hard contact 1: weights": "the surfaces are apart",
    "restitution": "the surfaces are apart",
    "regularisation": "of slip much slower than this",
    "compliance": "the surfaces are apart",
    "mobility": "weighs what a step solves",
}
"""Numbers that these motions do not show, and why."""


def moving_pair(effect):
    """Two bodies with an effect: system and state; a joint under test keeps its multipliers."""
    entry, scene = TABLE[effect], nc.Scene()
    spin = np.array((0.5, -0.4, 0.7))
    places = np.array([(0.0, 0.0, -1.0), (0.5, 0.3, -1.6)])
    starts = [
        {"position": place, "velocity": np.cross(spin, place), "angular_velocity": (1.0 + 3.0 * k) * spin}
        for k, place in enumerate(places)
    ]
    one = nc.RigidBody(mass=2.0, inertia=(0.3, 0.4, 0.5), com=(0.05, -0.03, 0.1), **starts[0], name="one")
    turned = {"orientation": (AXIS, 0.7), "name": "two"}
    two = nc.RigidBody(mass=1.5, inertia=(0.2, 0.12, 0.25), **starts[1], **turned)
    parts = Parts(scene.add(one), scene.add(two), None)
    kind = entry.joint if entry.make else with_multipliers(entry.joint)
    place = {"point": (0.2, 0.1, -1.3), "axis": AXIS, "second": SECOND, "name": "joint"}
    parts.joint = scene.add(kind(parts.one, parts.two, **place, **SPECIAL.get(entry.joint, {})))
    if entry.make:
        scene.add(entry.make(parts))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return scene.compile(assemble=effect in (nc.PointOnPlane, nc.PointOnLine, nc.Rolling))


def set_anew(system, part, field, value):
    """The system with a number that is larger by a twentieth; None if that is refused."""
    try:
        return system.set(part, **{field: 1.05 * value + (0.0 if np.any(value) else 0.01)})
    except ValueError:
        return None


@pytest.mark.parametrize(
    "effect",
    [pytest.param(e, marks=pytest.mark.slow if e in SOME else pytest.mark.exhaustive) for e in TABLE],
    ids=lambda e: e.__name__,
)
def test_every_number_that_is_set_is_heard(effect):
    """By a step of about half a radian, forwards or backwards."""
    system, state = moving_pair(effect)
    parts = [n for g in (*system.effects, *system.joints) for n in g.names if n]
    numbers = [
        (part, field, value)
        for part in dict.fromkeys([*system.structure.bodies, *parts])
        for field, value in system.get(part).items()
        if np.size(value) and np.all(np.isfinite(value))
    ]
    changed = [set_anew(system, *number) for number in numbers]
    heard = [(number, s) for number, s in zip(numbers, changed, strict=True) if s is not None]
    inputs = 0.5 + jnp.arange(len(system.structure.inputs))

    def seen(system, sign):
        begun = dataclasses.replace(state, v=sign * state.v)
        if effect is nc.JointStops:  # (beyond one of them)
            begun = system.with_coordinate(begun, "joint", 0.15 * sign)
        # (Strong dry friction takes shorter steps.)
        after = nc.step(system, begun, inputs, dt=0.02 if effect is nc.JointFriction else 0.2)
        return after.q, after.v, system.energy(begun).total, system.energy(after).total

    motions = jax.jit(jax.vmap(jax.vmap(seen, (None, 0)), (0, None)))
    stacked = jax.tree.map(lambda *x: jnp.stack(x), system, *(s for _, s in heard))
    lanes = [np.asarray(x) for x in jax.tree.leaves(motions(stacked, np.array([1.0, -1.0])))]
    assert heard and np.isfinite(lanes[0][0]).all()
    silent = [
        f"{part}: {field}"
        for k, ((part, field, _), _) in enumerate(heard)
        if all(np.array_equal(x[0], x[k + 1], equal_nan=True) for x in lanes)
    ]
    assert not [x for x in silent if UNHEARD.keys().isdisjoint((x, x.split(": ")[1]))], silent
