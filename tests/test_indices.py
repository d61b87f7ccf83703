"""Indices of a system are its structure, known in every program; its numbers are leaves."""

import copy
import pickle
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc


def drive(t):
    return 0.1 * t**2


def law(angle):
    return 0.5 * angle**2


@cache
def scene(stiffness=2.0, crossed=False):
    """Three bodies, springs and a drive; crossed: the last hangs on the first."""
    built = nc.Scene()
    built.add(nc.Gravity())
    bodies = [built.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.25))) for _ in range(3)]
    above = nc.ground, bodies[0], bodies[0] if crossed else bodies[1]
    joints = [nc.Revolute(*pair, point=(0.1 * k, 0, 0)) for k, pair in enumerate(zip(above, bodies))]
    hinges = [built.add(joint) for joint in joints]
    built.add(nc.JointSpring(hinges[0], stiffness=stiffness, name="spring"))
    built.add(nc.Drive(hinges[1], function=drive))
    built.add(nc.JointPotential(hinges[2], law=law))
    return built.compile()


def tables(system):
    """Every array of indices of a system, as it is now."""
    groups = (*system.joints, *system.effects)
    names = ("bodies", "joints", "inputs", "coordinates", "rotors", "works")
    tree = ("parent", "neighbour", "parent_in_level", "slot_index", "slot_of", "side", "order", "ball")
    return [
        system.joint_bodies,
        system.coordinate_order,
        *(getattr(system.tree, name) for name in tree),
        *(getattr(group, name) for group in groups for name in names),
        *(group.acting.entries for group in groups),
        *(x for group in system.coordinates for x in (group.joints, group.index)),
    ]


def test_they_are_known_in_every_program():
    """Under jit, vmap, grad and in a loop they are arrays of NumPy with their numbers; others are traced."""
    system, state = scene()
    wanted, seen = [np.asarray(x) for x in tables(system)], []

    def some(system, state):
        seen.append(tables(system))
        assert isinstance(system.mass, jax.core.Tracer)
        return jnp.sum(system.mass) * state.t

    def looped(system, state):
        return jax.lax.fori_loop(0, 2, lambda _, total: total + some(system, state), 0.0)

    several = jax.tree.map(lambda x: jnp.stack([x, x]), (system, state))
    jax.eval_shape(some, system, state)
    jax.eval_shape(jax.vmap(some), *several)
    jax.eval_shape(jax.grad(some), system, state)
    jax.eval_shape(looped, system, state)
    assert len(seen) == 4
    for found in seen:
        for x, known in zip(found, wanted, strict=True):
            assert isinstance(x, np.ndarray)
            np.testing.assert_array_equal(x, known)
    assert {x.dtype.kind for x in jax.tree.leaves(system)} == {"f"}, "something whole is a leaf"


def test_what_differs_by_numbers_is_one_program_and_what_differs_by_indices_another():
    count = []

    @jax.jit
    def some(system, state):
        count.append(1)
        return jnp.sum(system.mass * 0.0) + state.t

    system, state = scene()
    for one in (system, scene.__wrapped__()[0], system.set("spring", stiffness=5.0)):
        some(one, state)
    assert len(count) == 1
    one, other = scene()[0], scene(crossed=True)[0]
    assert [x.shape for x in jax.tree.leaves(one)] == [x.shape for x in jax.tree.leaves(other)]
    assert jax.tree.structure(one) != jax.tree.structure(other)
    some(*scene(crossed=True))
    assert len(count) == 2
    with pytest.raises(ValueError, match="joint_bodies"):
        jax.tree.map(jnp.add, one, other)


COPIES = {
    "pickle": lambda x: pickle.loads(pickle.dumps(x)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
    "tree.map": lambda x: jax.tree.map(jnp.asarray, x),
}


@pytest.mark.parametrize("kind", [*COPIES, "file"])
def test_copies_have_the_same_structure(kind, tmp_path):
    system = scene()[0]
    if kind == "file":
        nc.save(tmp_path / "system", system)
        found = nc.load(tmp_path / "system")
    else:
        found = COPIES[kind](system)
    assert jax.tree.structure(found) == jax.tree.structure(system)
    assert hash(jax.tree.structure(found)) == hash(jax.tree.structure(system))
    assert type(found.tree.parent) is type(system.tree.parent) and not found.tree.parent.flags.writeable


@pytest.mark.parametrize("runs", [False, pytest.param(True, marks=pytest.mark.exhaustive)])
def test_several_systems_at_once(runs):
    """Stacked systems give what each gives, under vmap and by themselves, with functions in their effects."""
    alone = [scene(stiffness) for stiffness in (2.0, 5.0)]
    alone = [(one, eqx.tree_at(lambda s: s.v, state, state.v + 0.1)) for one, state in alone]
    several = jax.tree.map(lambda *x: jnp.stack(x), *alone)
    assert several[0].batch == (2,)

    def end(system, state):
        return nc.simulate(system, state, dt=0.05, steps=4, throw=False).states.q[-1]

    def read(system, state):
        return system.tangent(state).v

    for found in (jax.vmap(end)(*several),) if runs else (jax.vmap(read)(*several), read(*several)):
        for lane, one in zip(found, alone, strict=True):
            wanted = (end if runs else read)(*one)
            np.testing.assert_allclose(lane, wanted, rtol=1e-12, atol=1e-12)


def test_what_is_taken_from_them_is_an_array_as_any_other():
    """Slices and results are leaves; traced indices give traced arrays."""
    kind: Any = type(scene()[0].joint_bodies)
    table = kind.of(np.array([[3, 0], [1, 2]]))
    assert not jax.tree.leaves(table)
    taken = table[0], table.T, table.reshape(-1), table.copy(), list(table)[0]
    for found in (*taken, table + 1, table == 1, np.repeat(table, 2), np.where(table > 1, table, 0)):
        assert len(jax.tree.leaves(found)) == 1 and isinstance(found, np.ndarray)
    assert table.max() == 3 and hash(table.max()) == hash(3)
    assert (table == table).all() and not (table != table).any()
    rows, k = jnp.arange(4.0), jnp.array(1)
    picked = jax.jit(lambda k: (table[k], table[:, k], table[1][k], (table % 2)[k]))(k)
    assert [x.tolist() for x in picked] == [[1, 2], [0, 2], 2, [1, 0]]
    np.testing.assert_array_equal(rows[table], jax.jit(lambda x: x[table])(rows))
    np.testing.assert_array_equal(rows.at[table[0]].add(1.0), [1, 1, 2, 4])
    np.testing.assert_array_equal(jax.vmap(lambda row: rows[row])(np.asarray(table)), rows[table])
    with pytest.raises(ValueError, match="read-only"):
        table[0, 0] = 1
    assert kind.of(table) is table and kind.of(None) is None
    one, same, other = (jax.tree.structure(kind.of(x)) for x in ([1, 2], [1, 2], [2, 1]))
    assert one == same != other and "[1, 2]" in str(one)


class Held(eqx.Module):
    table: Any
    scale: float = 1.0


def test_a_module_with_them_is_a_static_argument():
    """As a controller is: equal ones are one program, others are another."""
    kind: Any = type(scene()[0].joint_bodies)
    count = []

    def taken(held, x):
        count.append(1)
        return held.scale * x[held.table]

    run, x = jax.jit(taken, static_argnums=0), jnp.arange(3.0)
    for table in ([2, 0], [2, 0], [0, 1]):
        np.testing.assert_array_equal(run(Held(kind.of(table)), x), table)
    assert len(count) == 2
