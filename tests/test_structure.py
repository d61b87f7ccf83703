"""Structure of programs: what is absent costs nothing, what is equal is stacked, numbers are leaves."""

import json
import os
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "natcoord_jax" / "effects"
LEAVES = sorted(
    "natcoord_jax.effects." + ".".join(f.relative_to(FOLDER).with_suffix("").parts)
    for f in FOLDER.rglob("*.py")
    if f.name != "__init__.py"
)

# --- absent effects ---------------------------------------------------------------------------------------

# Scenes and the effect modules that they need; each module is needless in at least one of them.
SCENES = {
    "free bodies": (
        "",
        [],
    ),
    "hinge and motor": (
        "hinge = scene.add(nc.Revolute(one, two, point=(0.5, 0.0, 0.0)))\nscene.add(nc.JointTorque(hinge))",
        ["joints.coordinates", "joints.lower_pairs", "joints.relations", "actuators.motors"],
    ),
    "springs": (
        "scene.add(nc.Gravity())\n"
        "ends = nc.Point(one), nc.Point(two, (1.0, 0.0, 0.0))\n"
        "scene.add(nc.Spring(ends, stiffness=2.0))\n"
        "scene.add(nc.PointForce(ends[:1], force=(1.0, 0.0, 0.0)))",
        ["loads.gravity", "loads.point_loads", "springs.point_springs"],
    ),
    "coil": (
        "hinge = scene.add(nc.Revolute(one, two, point=(0.5, 0.0, 0.0)))\n"
        "scene.add(nc.JointSpring(hinge, stiffness=2.0))",
        ["joints.coordinates", "joints.lower_pairs", "joints.relations", "springs.joint_springs"],
    ),
}

PROGRAM = """
import hashlib, importlib.abc, importlib.machinery, json, sys, types
blocked = set({blocked!r})

class Stub(types.ModuleType):
    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {{}})

class Blocker(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name, path=None, target=None):
        return importlib.machinery.ModuleSpec(name, self) if name in blocked else None
    def create_module(self, spec):
        return Stub(spec.name)
    def exec_module(self, module):
        pass

sys.meta_path.insert(0, Blocker())
import jax
jax.config.update("jax_enable_x64", True)
import natcoord_jax as nc

found = {{}}
for name, code in {scenes!r}.items():
    scene = nc.Scene()
    one = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.25), name="one"))
    two = scene.add(nc.RigidBody(mass=2.0, inertia=(0.3, 0.2, 0.25), position=(1.0, 0.0, 0.0), name="two"))
    exec(code)
    system, state = scene.compile()
    run = jax.jit(lambda system, state, dt: nc.simulate(system, state, dt=dt, steps=3))
    text = run.lower(system, state, 0.1).as_text()
    found[name] = [hashlib.sha256(text.encode()).hexdigest(), len(text.splitlines())]
loaded = [name for name in blocked if name in sys.modules and not isinstance(sys.modules[name], Stub)]
print(json.dumps([found, loaded]))
"""


def lowered(scenes: dict[str, str], blocked: list[str]):
    program = PROGRAM.format(scenes=scenes, blocked=blocked)
    env = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=env, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]
    return json.loads(run.stdout.splitlines()[-1])


USUAL = ("hinge and motor", "springs")


def needed(scene: str) -> set[str]:
    return {"natcoord_jax.effects." + module for module in SCENES[scene][1]}


def test_each_effect_module_is_needless_in_a_scene():
    assert not set.intersection(*map(needed, USUAL))


@pytest.mark.parametrize(
    "name",
    [
        "springs",
        pytest.param("hinge and motor", marks=pytest.mark.slow),
        *(pytest.param(name, marks=pytest.mark.exhaustive) for name in SCENES if name not in USUAL),
    ],
)
def test_absent_effects_leave_nothing(name):
    """The lowered program, without locations, is the same byte for byte with their modules blocked."""
    blocked = sorted(set(LEAVES) - needed(name))
    scene = {name: SCENES[name][0]}
    program, loaded = lowered(scene, blocked)
    assert blocked and not loaded, f"not blocked: {loaded}"
    assert program == lowered(scene, [])[0]


# --- equal kinds ------------------------------------------------------------------------------------------


def star(arms: int, solver: str):
    """A free hub with equal arms on hinges, coils and motors on all of them."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    hub = scene.add(nc.RigidBody(mass=5.0, inertia=(1.0, 1.2, 1.4), name="hub"))
    for k in range(arms):
        angle = 2 * np.pi * k / arms
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        arm = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.25), position=2 * out))
        hinge = scene.add(nc.Revolute(hub, arm, point=out, axis=np.cross(out, (0.0, 0.0, 1.0))))
        scene.add(nc.JointSpring(hinge, stiffness=3.0 + k))
        scene.add(nc.JointTorque(hinge))
    return scene.compile(solver=solver)


def program(arms: int, solver: str):
    run = jax.jit(lambda s, x, u: nc.simulate(s, x, dt=0.01, inputs=u))
    return run.lower(*star(arms, solver), jnp.zeros((5, arms)))


SOLVERS = pytest.mark.parametrize(
    "solver",
    [
        pytest.param("recursive", marks=pytest.mark.slow),
        *(pytest.param(x, marks=pytest.mark.exhaustive) for x in ("full", "reduced")),
    ],
)


@pytest.mark.filterwarnings("ignore:.*solved densely")
@SOLVERS
def test_program_size_does_not_grow_with_bodies(solver):
    """Small programs write out short products and sums, and are shorter or longer for it."""
    lines = {n: len(program(n, solver).as_text().splitlines()) for n in (4, 96)}
    assert lines[96] <= 1.35 * lines[4], f"lines by number of arms: {lines}"


@pytest.mark.exhaustive
def test_program_size_of_large_arrays_is_the_same():
    lines = {n: len(program(n, "recursive").as_text().splitlines()) for n in (96, 160)}
    assert abs(lines[160] - lines[96]) <= 0.01 * lines[96], f"lines by number of arms: {lines}"


@pytest.mark.exhaustive
def test_compile_time_does_not_grow_with_bodies():
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        seconds = {}
        for arms in (4, 48):
            spent = []
            for _ in range(2):
                text = program(arms, "recursive")
                # Processor time: what else runs on the machine must not decide.
                start = time.process_time()
                text.compile()
                spent.append(time.process_time() - start)
            seconds[arms] = min(spent)
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    # Twelve times the bodies: 2.4 times the compilation was seen (12.5 s for 5.1 s), for a program of one
    # size. It should not grow at all; the bound holds what there is.
    assert seconds[48] <= 2.5 * seconds[4] + 1.0, f"seconds of compilation by number of arms: {seconds}"


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:.*solved densely")
def test_solvers_give_one_trajectory():
    """Of a star, whose bodies each solver puts in an order of its own."""
    inputs, places = jnp.sin(jnp.arange(100.0))[:, None] * jnp.arange(1.0, 6.0), []
    for solver in ("reduced", "recursive", "full"):
        system, state = star(5, solver)
        rows = np.asarray(nc.simulate(system, state, dt=0.02, inputs=inputs).states.rows)
        places.append(rows[:, [system.body_index(name) for name in sorted(system.structure.bodies)]])
    assert np.max(np.abs(places - places[0])) <= tol.SAME_TRAJECTORY


def blocks_on_springs(count, closed, solver=None):
    """Free blocks in a row, or in a ring, on springs and dampers between their corners."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    blocks = [
        scene.add(nc.RigidBody(mass=1.0 + k, inertia=(0.1, 0.2, 0.25), position=(0.5 * k, 0.0, 0.0)))
        for k in range(count)
    ]
    pairs = list(zip(blocks, blocks[1:])) + [(nc.ground, blocks[0])] + [(blocks[-1], blocks[0])] * closed
    for k, (one, other) in enumerate(pairs):
        ends = nc.Point(one, (0.5 * k + 0.1, 0.1, 0.0)), nc.Point(other, (0.5 * k + 0.4, 0.0, 0.1))
        kinds = nc.Spring(ends, stiffness=300.0, length=0.3), nc.Damper(ends, damping=0.5)
        for kind in kinds[: 1 + k % 2]:
            scene.add(kind)
    return scene.compile(solver=solver)


@pytest.mark.exhaustive
def test_chains_on_springs_are_solved_along_the_chain():
    system, state = blocks_on_springs(7, closed=False)
    assert system.structure.solver == "recursive"
    assert blocks_on_springs(7, closed=True)[0].structure.solver != "recursive"
    dense, start = blocks_on_springs(7, closed=False, solver="full")
    for order in (2, 4):
        scheme = nc.EnergyMomentum(order)
        a = nc.simulate(system, state, dt=0.02, steps=25, scheme=scheme)
        b = nc.simulate(dense, start, dt=0.02, steps=25, scheme=scheme)
        assert jnp.max(jnp.abs(a.q - b.q)) <= tol.SAME_TRAJECTORY


@cache
def gradient_and_curvature(solver):
    """Reverse, and forward over reverse, with respect to the inputs."""
    inputs = jnp.sin(jnp.arange(10.0))[:, None] * jnp.arange(1.0, 4.0)
    system, state = star(3, solver)

    def loss(u):
        after = nc.simulate(system, state, dt=0.02, inputs=u)
        return jnp.sum(after.v[-1] ** 2) + jnp.sum(jnp.sin(after.q[-1]))

    return jax.jit(lambda u: jax.jvp(jax.grad(loss), (u,), (jnp.cos(u),)))(inputs)


@pytest.mark.exhaustive
def test_solvers_give_one_gradient():
    for solver in ("recursive", "full"):
        for a, b in zip(gradient_and_curvature("reduced"), gradient_and_curvature(solver)):
            assert jnp.max(jnp.abs(a - b)) <= tol.SAME_GRADIENT * jnp.max(jnp.abs(a)), solver


# --- numbers are leaves -----------------------------------------------------------------------------------


class Idle(nc.Force):
    """A force of one's own that does nothing."""

    def load(self, x, rate, inputs, t):
        """Nothing."""
        return nc.Load(0.0 * rate, None)


def test_a_changed_number_never_retraces(programs):
    """Every leaf of system and state, the step, the inputs, also more of them; a scene built anew."""

    def scene(mass=1.0, stiffness=2.0, place=0.5):
        made = nc.Scene()
        made.add(nc.Gravity(vector=(0.0, 0.1 * mass, -9.81)))
        one = made.add(nc.RigidBody(mass=mass, inertia=(0.1, 0.2, 0.25), name="one"))
        hinge = made.add(nc.Revolute(nc.ground, one, point=(place, 0.0, 0.0)))
        made.add(nc.JointSpring(hinge, stiffness=stiffness))
        made.add(nc.JointTorque(hinge))
        made.add(Idle((nc.Point(one),)))
        return made.compile()

    system, state = scene()
    first = nc.simulate(system, state, dt=0.1, inputs=jnp.zeros((4, 1)))
    assert "jit(simulated)" in programs
    scenes = [scene(mass=2.0), scene(stiffness=5.0), scene(place=0.3)]
    programs.clear()
    runs = [nc.simulate(*s, dt=0.1, inputs=jnp.zeros((4, 1))) for s in scenes]
    runs.append(nc.simulate(system, state, dt=0.05, inputs=jnp.zeros((4, 1))))
    runs.append(nc.simulate(system, state, dt=0.1, inputs=jnp.ones((4, 1))))
    floats, structure = eqx.partition(system, eqx.is_inexact_array)
    moved = eqx.combine(jax.tree.map(lambda x: x * 1.01, floats), structure)
    runs.append(nc.simulate(moved, state, dt=0.1, inputs=jnp.zeros((4, 1)), throw=False))
    later = eqx.tree_at(lambda s: s.t, state, state.t + 1.0)
    runs.append(nc.simulate(system, later, dt=0.1, inputs=jnp.zeros((4, 1))))
    assert nc.simulate(system, state, dt=0.1, inputs=jnp.zeros((11, 1))).q.shape[0] == 12
    assert "jit(simulated)" not in programs, "a rollout was compiled again"
    assert all(float(jnp.max(jnp.abs(x.q - first.q))) > 0 for x in runs[:-1])


@pytest.mark.exhaustive
def test_a_scene_of_traced_numbers():
    """Building inside jit gives the numbers of building outside."""

    def build(mass, place):
        scene = nc.Scene()
        body = scene.add(nc.RigidBody(mass=mass, inertia=(0.1, 0.2, 0.25), com=(0.1, 0.0, 0.0)))
        scene.add(nc.Revolute(nc.ground, body, point=place, axis=(0.0, 1.0, 0.0)))
        scene.add(nc.Gravity())
        return scene.compile()

    mass, place = jnp.array(1.7), jnp.array([0.3, 0.0, 0.1])
    outside, inside = build(mass, place), jax.jit(lambda m, p: build(m, p)[1])(mass, place)
    assert jax.tree.all(jax.tree.map(lambda a, b: jnp.allclose(a, b), outside[1], inside))
    answer = jax.jit(lambda m, p: nc.simulate(*build(m, p), dt=0.05, steps=10).q)(mass, place)
    assert np.allclose(answer, nc.simulate(*outside, dt=0.05, steps=10).q, atol=tol.INDIFFERENCE)


def test_a_batch_of_runs_shares_one_program():
    """vmap over states lowers to a program of the same size for any number of lanes."""
    system, state = star(2, "reduced")

    def run(v):
        return nc.simulate(system, eqx.tree_at(lambda s: s.v, state, v), dt=0.01, steps=2).q

    def size(lanes):
        program = jax.jit(jax.vmap(run)).lower(jnp.stack([state.v] * lanes))
        return len(program.as_text().splitlines())

    assert size(2) == size(64)
