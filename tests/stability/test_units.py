"""Every effect of the contract table in other units: of length, time and mass, by what its docstring says.

What could go wrong: metres, seconds or kilograms are written into a tolerance, a guess or a law, so that what
is small, slow or light moves otherwise; a docstring says another unit than the law has.
"""

import dataclasses
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from scenes import AXIS, SECOND, SPECIAL, with_multipliers
from test_contracts import TABLE, Parts

import natcoord_jax as nc

BASES = {"m": (1, 0, 0), "s": (0, 1, 0), "kg": (0, 0, 1), "N": (1, -2, 1), "J": (2, -2, 1)}
"""Powers of length, time and mass in units; others have none."""
OTHERS = np.array(
    [(1, 1, 1), (1e-3, 1, 1), (1e-6, 1e-3, 1e-6), (1e4, 1e3, 1e6), (1, 1e-3, 1e3), (1e-4, 10, 1)]
)
"""Lengths, times and masses, as they are and in other units."""

FUNCTIONS = {
    nc.Drive: ("s", "rad"),
    nc.NonlinearSpring: ("m", "J"),
    nc.JointPotential: ("rad", "J"),
    nc.PointForce: ("s", "N"),
    nc.BodyTorque: ("s", "N m"),
    nc.EdgeSegment: ("s", "N/m"),
    **dict.fromkeys((nc.FacePressure, nc.FacePressure6, nc.FacePressure8, nc.FacePressure9), ("s", "N/m^2")),
}
"""Units of the argument and the value of the function that an effect has."""
INPUTS = {nc.JointForce: "N", nc.BodyForceInput: "N", nc.WrenchInput: "-"}
"""Units of inputs that are no torques."""
ASIDE = {
    nc.AffineActuator: "its length is a sum of an angle and a displacement",
    nc.NonlinearBeamElement: "its law is one of numbers without unit",
    nc.PointOnPlane: "it does not start in the plane",
    nc.Rolling: "it does not start on the plane",
}
FEW = (nc.Rod, nc.JointSpring)
SOME = (
    nc.Spring,
    nc.Screw,
    nc.GapConstraint,
    nc.GapPotential,
    nc.BeamElement,
    nc.Drive,
    nc.Damper,
    nc.Armature,
)


class Scaled(eqx.Module):
    """A function in other units."""

    function: Any = eqx.field(static=True)
    argument: Any
    value: Any

    def __call__(self, x):
        return self.value * self.function(x / self.argument)


def scale(unit: str, units) -> Any:
    """Of a unit as "N m/rad", in units of length, time and mass."""
    above, *below = unit.split("/")
    powers = np.zeros(3)
    for text, sign in [(above, 1), *((x, -1) for x in below)]:
        for factor in text.split():
            base, _, power = factor.partition("^")
            powers += sign * float(power or 1) * np.array(BASES.get(base, (0, 0, 0)))
    return jnp.prod(units**powers)


def unit_of(kind: type, name: str) -> str:
    """As the docstring of a class has it."""
    for owner in kind.__mro__:
        text = (owner.__doc__ or "") + "\n"
        entry = re.search(rf"^( *){name}: ?((?:.*\n)(?:\1 +.*\n)*)", text, re.MULTILINE)
        unit = re.search(r"\[([^\[\]]+)\]", entry[2]) if entry else None
        if unit:
            return unit[1]
    return "-"


def in_units(part: Any, units: Any, slides: bool) -> Any:
    """A part with all its numbers in other units; `slides`: of a joint coordinate that is a displacement."""
    length, changes = units[0], {}
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if field.name == "markers":
            changes["markers"] = tuple(placed(marker, length) for marker in value or ())
        elif callable(value) and not isinstance(value, eqx.Module | type):
            argument, result = (scale(unit, units) for unit in FUNCTIONS[type(part)])
            changes[field.name] = Scaled(value, argument, result)
        elif isinstance(value, eqx.Module):
            changes[field.name] = in_units(value, units, slides)
        elif field.init and not field.metadata.get("static") and is_floating(value):
            first, *more = unit_of(type(part), field.name).split(",")
            choices = first.split(" or ")
            factor = scale(choices[-1 if slides else 0], units)
            shape, bends = np.shape(value), jnp.ones(6).at[3:].set(length)
            if more and shape == (6, 6):  # of strains and curvatures
                factor = factor * bends[:, None] * bends
            elif more and shape[-1:] == (6,):
                factor = factor / bends
            changes[field.name] = factor * jnp.asarray(value)
    if not changes.get("markers", True):
        del changes["markers"]
    return dataclasses.replace(part, **changes)


def is_floating(value: Any) -> bool:
    if value is None or isinstance(value, str | bool | int):
        return False
    try:
        return np.asarray(value).dtype.kind == "f"
    except TypeError:
        return False


def placed(marker: Any, length: Any) -> Any:
    """A point or an attachment in another unit of length; directions are as they are."""
    if isinstance(marker, nc.Attachment):
        return dataclasses.replace(marker, point=length * jnp.asarray(marker.point))
    return dataclasses.replace(
        marker, vector=(length if marker.is_point else 1.0) * jnp.asarray(marker.vector)
    )


def moved(effect: type, units: Any) -> Any:
    """The pair of the table after a step, without units: places, speeds, energy."""
    (length, time, mass), entry, scene = units, TABLE[effect], nc.Scene()

    def body(mass_of, inertia, com, place, spin, **more):
        part = nc.RigidBody(
            mass=mass * mass_of,
            inertia=mass * length**2 * np.array(inertia),
            com=length * np.array(com),
            position=length * np.array(place),
            velocity=length / time * np.array(spin[::-1]),
            angular_velocity=np.array(spin) / time,
            **more,
        )
        return scene.add(part)

    one = body(2.0, (0.3, 0.4, 0.5), (0.05, -0.03, 0.1), (0.0, 0.0, -1.0), (0.4, -0.3, 0.5), name="one")
    turned = {"orientation": (AXIS, 0.7), "name": "two"}
    two = body(1.5, (0.2, 0.12, 0.25), (0.0, 0.0, 0.0), (0.5, 0.3, -1.6), (-0.2, 0.6, 0.3), **turned)
    kind = entry.joint if entry.make else with_multipliers(entry.joint)
    options = {key: length * np.array(x) for key, x in SPECIAL.get(entry.joint, {}).items()}
    place = {"point": length * np.array((0.2, 0.1, -1.3)), "axis": AXIS, "second": SECOND}
    joint = scene.add(kind(one, two, **place, name="joint", **options))
    if entry.make:
        made: Any = entry.make(Parts(one, two, joint))
        number = getattr(made, "coordinate", 0)
        number = number if isinstance(number, int) else 0
        slides = bool(entry.joint.coordinates) and entry.joint.coordinates[number].unit == "m"
        made = in_units(made, units, slides)
        if effect is nc.Coupling:
            made = dataclasses.replace(made, factors=jnp.stack([jnp.ones(()), -0.7 / length]))
        scene.add(made)
    system, state = scene.compile()
    inputs = (0.5 + jnp.arange(len(system.structure.inputs))) * scale(INPUTS.get(effect, "N m"), units)
    after = nc.step(system, state, inputs, dt=0.05 * time)
    energy = system.energy(after).total / scale("J", units)
    rows, rates = after.rows, after.row_rates * time
    sizes = jnp.ones(4).at[0].set(length)[:, None]
    return rows / sizes, rates / sizes, energy


@pytest.mark.parametrize(
    "effect",
    [
        pytest.param(e, marks=() if e in FEW else pytest.mark.slow if e in SOME else pytest.mark.exhaustive)
        for e in TABLE
        if e not in ASIDE
    ],
    ids=lambda e: e.__name__,
)
def test_units_of_length_time_and_mass(effect):
    """A step from micrometres to tens of kilometres, milliseconds to kiloseconds, milligrams to kilotons."""
    lanes = [np.asarray(x) for x in jax.jit(jax.vmap(lambda units: moved(effect, units)))(OTHERS)]
    assert np.isfinite(lanes[0][0]).all()
    for lane in lanes:
        off = np.abs(lane - lane[0]).reshape(len(OTHERS), -1).max(axis=1) / max(1.0, np.abs(lane[0]).max())
        assert off.max() <= tol.SAME_TRAJECTORY, off
