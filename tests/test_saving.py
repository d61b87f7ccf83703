"""Saved and loaded: systems, states, trajectories, problems, solutions."""

import json
import zipfile

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery


def softening(x):
    """A law of one's own, at the top of a module."""
    return 3.0 * x**2 / (1.0 + x**2)


def again(x, path):
    nc.save(path, x)
    return nc.load(path)


def assert_equal(one, other):
    """The same structure, types and bits."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert type(x) is type(y)
        if isinstance(x, jax.Array | np.ndarray):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n == "pendulum" else pytest.mark.exhaustive) for n in gallery.SCENES],
)
def test_scenes_come_back(name, tmp_path, programs):
    """With an equal structure: they serve the same programs, with the same results."""
    example = gallery.load(name)
    system, state = again((example.system, example.state), tmp_path / "scene.nc")
    assert_equal((system, state), (example.system, example.state))
    assert system.structure == example.system.structure
    assert hash(system.structure) == hash(example.system.structure)
    assert system.report() == example.system.report()
    before = nc.simulate(example.system, example.state, dt=example.dt, steps=2, throw=False)
    del programs[:]
    after = nc.simulate(system, state, dt=example.dt, steps=2, throw=False)
    assert not programs
    assert_equal(before, after)


def swing(energy=softening):
    scene = nc.Scene()
    arm = scene.add(nc.RigidBody(mass=2.0, inertia=(1.0, 1.0, 1.0), com=(1.0, 0.0, 0.0), name="arm"))
    hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointPotential(hinge, law=energy, name="spring"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


def test_laws_of_ones_own_are_found_by_name(tmp_path):
    system, state = swing()
    loaded, start = again((system, state), tmp_path / "swing.nc")
    assert_equal((loaded, start), (system, state))
    run = {"dt": 0.05, "steps": 4, "inputs": np.ones(1)}
    trajectory = nc.simulate(system, state, **run)
    assert_equal(nc.simulate(loaded, start, **run), trajectory)
    assert_equal(again(trajectory, tmp_path / "run.nc"), trajectory)
    structure = zipfile.ZipFile(tmp_path / "swing.nc").read("structure.json").decode()
    assert f"{__name__}:softening" in structure


def test_what_has_no_name_is_refused(tmp_path):
    with pytest.raises(ValueError, match="lambda.*define it at the top of a module"):
        nc.save(tmp_path / "swing.nc", swing(lambda x: x**2))
    with pytest.raises(ValueError, match="is no data"):
        nc.save(tmp_path / "file.nc", {"iterator": iter([])})
    assert not list(tmp_path.iterdir())


def problem_of(system, state):
    return nc.OptimalControl(system, state, dt=0.1, steps=3, cost=nc.cost.Effort(), goal=nc.goal.Rest())


def test_problems_come_back(tmp_path):
    problem = problem_of(*swing())
    assert_equal(again(problem, tmp_path / "x.nc"), problem)


@pytest.mark.exhaustive
def test_solutions_come_back(tmp_path):
    solution = nc.optimise(problem_of(*swing()), max_iterations=2)
    loaded = again(solution, tmp_path / "x.nc")
    np.testing.assert_array_equal(loaded.inputs, solution.inputs)
    assert loaded.explain() == solution.explain() and loaded.outcome == solution.outcome


def test_containers_and_networks_come_back(tmp_path):
    network = eqx.nn.MLP(2, 1, 8, 2, activation=jax.nn.tanh, key=jax.random.key(0))
    x = {"numbers": (1, 2.5, np.inf, None, True), "array": np.arange(3), "code": nc.Result.SINGULAR}
    loaded = again((network, x), tmp_path / "x.nc")
    assert_equal(loaded, (network, x))
    np.testing.assert_array_equal(loaded[0](jnp.ones(2)), network(jnp.ones(2)))


def changed(path, change):
    """The file with something else in its head."""
    with zipfile.ZipFile(path) as file:
        content = {name: file.read(name) for name in file.namelist()}
    head = json.loads(content["structure.json"])
    change(head)
    with zipfile.ZipFile(path, "w") as file:
        for name, x in (content | {"structure.json": json.dumps(head)}).items():
            file.writestr(name, x)


def test_files_that_do_not_fit_are_refused_with_the_reason(tmp_path):
    path = tmp_path / "state.nc"
    nc.save(path, swing()[1])
    changed(path, lambda head: head.update(format=99))
    with pytest.raises(ValueError, match="has format 99, this version reads format 1"):
        nc.load(path)
    nc.save(path, swing()[1])
    changed(path, lambda head: head["fields"]["natcoord_jax.core.state:State"].append("spin"))
    with pytest.raises(ValueError, match=r"State no longer has \['spin'\]"):
        nc.load(path)
    nc.save(path, swing()[0])
    changed(path, lambda head: head.update(json.loads(json.dumps(head).replace(":softening", ":hardening"))))
    with pytest.raises(ValueError, match="'hardening' of the module"):
        nc.load(path)
    path.write_bytes(b"something else")
    with pytest.raises(ValueError, match="is no file of nc.save"):
        nc.load(path)


def test_no_file_runs_anything(tmp_path):
    """Names lead to classes of data and functions, which are not called."""
    path = tmp_path / "x.nc"
    nc.save(path, 1)
    for what in ({"class": "os:system", "fields": {}}, {"class": "subprocess:Popen", "fields": {}}):
        changed(path, lambda head, what=what: head.update(what=what))
        with pytest.raises(ValueError, match="is no class"):
            nc.load(path)
