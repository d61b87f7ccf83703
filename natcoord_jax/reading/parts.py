"""Numbers of the parts of a system, by name: read, and set in a copy."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import unit_of
from natcoord_jax.core.bodies import mass_block
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.eager_numpy import broadcast, eager_numpy
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.handles import Handle, named
from natcoord_jax.core.inertia import diagonal, even, is_even, possible, tensor, to_second_moment
from natcoord_jax.core.kinds import is_other
from natcoord_jax.core.names import listed
from natcoord_jax.core.numeric import Number, array_of
from natcoord_jax.model.groups import Group
from natcoord_jax.model.masses import with_mass
from natcoord_jax.model.model import Model, SomeModel
from natcoord_jax.reading.admissible import as_declared, in_range, sound, without_flaws

Names = Handle | str | Sequence[Handle | str]

BODY = "mass", "com", "inertia"
"""What the mass block of a body is made of."""
UNITS = {"mass": " [kg]", "com": " [m]", "inertia": " [kg m^2]", "mass_block": " [kg, kg m, kg m^2]"}
"""Of the numbers of a body."""

MASS = Number("positive")


class Place(NamedTuple):
    """Where a number of a part is: the leaf of the system, its row (None: all of it), and the part's kind."""

    leaf: int
    row: int | None
    kind: str


def _names(part: Names) -> tuple[str, ...]:
    listed = [part] if isinstance(part, Handle | str) else part
    return tuple(map(named, listed))


def _several(system: Model, part: Names) -> Names:
    """The parts "name[0]" and so on of a name that is no part itself: of a contact with several gaps, say."""
    if not isinstance(part, str) or part in system.structure.bodies:
        return part
    known = [n for g in (*system.joints, *system.effects) for n in (*g.names, *g.labels)]
    parts = [] if part in known else [n for n in dict.fromkeys(known) if n.startswith(f"{part}[")]
    return parts or part


def _in_group(group: Group, numbered: Group, name: str) -> dict[str, Place]:
    """Floating numbers of an effect, or of the relation of a joint."""
    row = group.names.index(name) if group.lanes and name in group.names else None
    kind = f"{group.effect.kind} {name!r}"
    paths, _ = jax.tree_util.tree_flatten_with_path(group.effect)
    leaves = jax.tree.leaves(numbered.effect)
    found = {
        jax.tree_util.keystr(path, simple=True, separator="."): Place(leaf, row, kind)
        for (path, value), leaf in zip(paths, leaves, strict=True)
        if eqx.is_inexact_array(value)
    }
    if group.weights is not None:
        leaf: Any = numbered.weights
        found["weights"] = Place(leaf, row, kind)
    return found


def places(system: Model, name: str) -> dict[str, Place]:
    """Where the numbers of a part are, by name of its field.

    Raises:
        ValueError: for a name that is no part of the system.
    """
    leaves, tree = jax.tree.flatten(system)
    # The system with the numbers of its leaves instead of these.
    numbered, structure = jax.tree.unflatten(tree, range(len(leaves))), system.structure
    found: dict[str, Place] = {}
    if name in structure.bodies:
        leaf: Any = numbered.mass
        return {"mass_block": Place(leaf, structure.bodies.index(name), f"body {name!r}")}
    if name and name in structure.joints:
        leaf = numbered.frames
        found["frames"] = Place(leaf, structure.joints.index(name), f"joint {name!r}")
    groups = zip((*system.joints, *system.effects), (*numbered.joints, *numbered.effects), strict=True)
    for group, same in groups:
        if name in group.names or name in group.labels:
            return found | _in_group(group, same, name)
    joints = [n for n in structure.joints if n]
    bodies, effects = listed(structure.bodies), [n for g in system.effects for n in listed(g.names)]
    raise ValueError(
        f"this system has no part {name!r}; it has the bodies {bodies}, the joints {joints} "
        f"and the effects {effects}"
    )


def _fields(system: Model, name: str, found: dict[str, Place]) -> list[str]:
    """What can be read and set of a part."""
    if "mass_block" not in found:
        return list(found)
    index = system.structure.bodies.index(name)
    return ["mass_block", *BODY[: 1 if index in system.structure.points else 3]]


@eager_numpy
def _parted(block: Float[Array, "4 4"]) -> dict[str, Array]:
    """Mass [kg], centre of mass [m] and inertia about it [kg m^2] of a mass block (15)."""
    mass = block[0, 0]
    known = mass != 0
    com = jnp.where(known, block[0, 1:] / jnp.where(known, mass, 1.0), 0.0)
    moment = block[1:, 1:] - mass * jnp.outer(com, com)
    return {"mass": mass, "com": com, "inertia": jnp.trace(moment) * jnp.eye(3) - moment}


@eager_numpy
def _block(mass: Array, com: Float[Array, "3"], inertia: Float[Array, "3 3"]) -> Float[Array, "4 4"]:
    """The mass block (15) of these."""
    return mass_block(mass, com, to_second_moment(inertia) + mass * jnp.outer(com, com))


@eager_numpy
def _with_row(leaf: Array, row: int | None, value: Array) -> Array:
    return value if row is None else leaf.at[row].set(value)


def get(system: Model, part: Names, field: str | None = None) -> Any:
    """Numbers of a part, or one of them; see `System.get`."""
    part = _several(system, part)
    if not isinstance(part, Handle | str):
        each = [get(system, name, field) for name in _names(part)]
        return jax.tree.map(lambda *x: jnp.stack(x), *each)
    (name,) = _names(part)
    found = places(system, name)
    known = _fields(system, name, found)
    leaves = jax.tree.leaves(system)
    values = {key: jnp.asarray(leaves[x.leaf])[() if x.row is None else x.row] for key, x in found.items()}
    if "mass_block" in found:
        values |= _parted(values["mass_block"])
    values = {key: values[key] for key in known}
    if field is None:
        return values
    return values[_whole_name(name, known, field, next(iter(found.values()), None))]


def set_numbers(system: SomeModel, part: Names, values: dict[str, Any]) -> SomeModel:
    """A copy with other numbers in a part or in several; see `System.set`."""
    part = _several(system, part)
    names = _names(part)
    many = not isinstance(part, Handle | str)
    if not values:
        raise ValueError(f"nothing to set in {list(names)}: pass numbers by the name of their field")
    for k, name in enumerate(names):
        found = places(system, name)
        known = _fields(system, name, found)
        kind = next(iter(found.values()), None)
        now = get(system, name)
        given = {}
        for field, value in values.items():
            field = _whole_name(name, known, field, kind)
            label = f"{repr(name) if kind is None else kind.kind}: {field}{_unit(system, name, field)}"
            every = found[field].row is None if field in found else False
            if field == "inertia":
                value = _principal(value, len(names), several=many)
            given[field] = _fitting(value, now[field], k if many else None, len(names), label, every=every)
        given = as_declared(system, name, given)
        if "mass_block" in found:
            given = _as_block(name, now, given)
        leaves, structure = jax.tree.flatten(system)
        for field, value in given.items():
            leaf, row, _ = found[field]
            leaves[leaf] = _with_row(jnp.asarray(leaves[leaf]), row, value)
        system = _renewed(system, jax.tree.unflatten(structure, leaves), name, set(given))
        system = _with_companions(without_flaws(sound(system, given), name), name, set(given))
    return system


def _with_companions(system: SomeModel, name: str, given: set[str]) -> SomeModel:
    """The system with the effects that come with a joint, as a pitch relation, by its numbers."""
    for group in system.joints:
        if name in group.names and given - {"frames"}:
            row = group.names.index(name)
            joint: Any = jax.tree.map(lambda x, row=row: x[row], group.effect)
            for effect in joint.companions(Handle("joint", name, 0)):
                fields = {f.name: getattr(effect, f.name) for f in dataclasses.fields(effect)}
                numbers = {key: value for key, value in fields.items() if eqx.is_inexact_array(value)}
                system = set_numbers(system, effect.name, numbers)
    return system


def _renewed(before: Model, after: SomeModel, name: str, given: set[str]) -> SomeModel:
    """The system with what follows from the numbers of an effect that have been set, masses included."""
    effects, mass, between = list(after.effects), after.mass, after.mass_between
    for number, (old, group) in enumerate(zip(before.effects, after.effects)):
        if name not in group.names and name not in group.labels:
            continue
        kind = type(group.effect)
        if kind.renewed is not Effect.renewed and not given <= {*kind.derived, "weights"}:
            row = group.names.index(name) if group.lanes and name in group.names else None
            effects[number] = replace_fields(group, effect=_anew(group.effect, row))
        mass, between = with_mass(mass, between, effects, number, old.effect)
    return replace_fields(after, effects=tuple(effects), mass=mass, mass_between=between)


@eager_numpy
def _anew(effect: Effect, row: int | None) -> Effect:
    """All instances renewed, or one of them."""
    if row is None:
        return jax.vmap(lambda e: e.renewed())(effect)
    one = jax.tree.map(lambda x: x[row], effect).renewed()
    return jax.tree.map(lambda x, y: x.at[row].set(y), effect, one)


def _as_block(name: str, now: dict[str, Array], given: dict[str, Array]) -> dict[str, Array]:
    """The mass block of what is given, and of what is kept."""
    label = f"body {name!r}"
    if "mass_block" in given:
        if len(given) > 1:
            raise ValueError(f"{label}: pass mass_block, or some of {list(BODY)}, not both")
        block = even(given["mass_block"], f"{label}: mass_block [kg, kg m, kg m^2]")
        parts = _parted(block)
        mass, central = parts["mass"], to_second_moment(parts["inertia"])
        in_range(MASS, mass, f"{label}: mass [kg]")
        return {"mass_block": possible(block, central / (mass > 0), block[1:, 1:], label, "mass_block")}
    if "mass" in given:
        given = {**given, "mass": in_range(MASS, given["mass"], f"{label}: mass [kg]")}
    if "inertia" not in now:
        return {"mass_block": now["mass_block"].at[0, 0].set(given["mass"])}
    if "inertia" in given:
        inertia = tensor(given["inertia"], f"{label}: inertia")
        about = to_second_moment(inertia)
        given = {**given, "inertia": possible(inertia, about, about, label, "inertia")}
    return {"mass_block": _block(*(given.get(key, now[key]) for key in BODY))}


def _whole_name(name: str, known: list[str], field: str, place: Place | None) -> str:
    """Name of a number of a part: "E" stands for "material.E" where there is no other."""
    ends = [key for key in known if key == field] or [key for key in known if key.endswith(f".{field}")]
    if len(ends) != 1:
        label = repr(name) if place is None else place.kind
        raise ValueError(
            f"the {label} has no number {field!r}; it has {known}. Not among them are what a function closes "
            "over (change it where it is, the next call sees it) and what only the assembled pose takes, as "
            "the point and the zero of a joint (change it in the scene, and compile that)"
        )
    return ends[0]


def _unit(system: Model, name: str, field: str) -> str:
    """Unit of a number of a part, " [m]"; "" if it is not known."""
    owners = [type(g.effect) for g in (*system.joints, *system.effects) if name in (*g.names, *g.labels)]
    return next((unit for owner in owners if (unit := unit_of(owner, field))), UNITS.get(field, ""))


def _principal(value: Any, count: int, *, several: bool) -> Any:
    """Inertias by their diagonals, also of several bodies; what has another shape as it is.

    A matrix of three rows is one for all of three bodies where it is symmetric, and else has a row for each.
    No symmetric matrix is both: its rows would be inertias of no body.
    """
    if array_of(value) is None:
        return value
    array = as_array(value, float)
    if array.shape not in ((3,), (count, 3)):
        return value
    if array.shape == (3, 3) and several:
        xp: Any = np if is_concrete(array) else jnp
        return xp.where(is_even(xp.asarray(array)), xp.asarray(array)[None], diagonal(array))
    return diagonal(array) if array.ndim == 1 or several else array


def _fitting(value: Any, now: Array, k: int | None, count: int, label: str, *, every: bool = False) -> Array:
    """A value of the shape of the one that is there; of several parts one for all, or one for each.

    Of a set, `every`, one for all elements will do as well.
    """
    if array_of(value) is None:
        raise ValueError(f"{label} {is_other(value)}; pass numbers")
    array = as_array(value, float)
    if every and k is None and array.shape == now.shape[1:]:
        array = broadcast(array, now.shape)
    shapes = [now.shape] + ([(count, *now.shape)] if k is not None else [])
    if array.shape not in shapes:
        wanted = " or ".join(map(str, shapes))
        raise ValueError(f"{label} has shape {array.shape}; pass shape {wanted}")
    if is_concrete(array) and np.any(np.isnan(np.asarray(array))):
        raise ValueError(f"{label} is not a number: {np.asarray(array)}; pass finite numbers")
    return array if array.shape == now.shape else array[k]
