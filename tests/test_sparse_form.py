"""The form of the equations with a sparse Jacobian: same trajectory and derivatives as the dense one."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc


def ladder(length: int, solver: str | None, *, rods: int = 1):
    """Two chains of bodies on ball joints, side by side, with rods across that close loops."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, 0.0, -9.81)))
    bodies = [
        [
            scene.add(nc.RigidBody(mass=1.0, inertia=(0.02, 0.1, 0.1), position=(k + 0.5, float(j), 0.0)))
            for k in range(length)
        ]
        for j in range(2)
    ]
    for j, row in enumerate(bodies):
        for k, body in enumerate(row):
            before = row[k - 1] if k else nc.ground
            scene.add(nc.Spherical(before, body, point=(float(k), float(j), 0.0)))
    for k in range(1, length, 2):
        for _ in range(rods):
            near, far = (row[k] for row in bodies)
            rod = nc.Distance(near, far, parent_point=(k + 0.7, 0.0, 0.0), point=(k + 0.6, 1.0, 0.0))
            scene.add(rod)
    return scene.compile(solver=solver)


pytestmark = pytest.mark.slow  # two forms, and both derivatives of each, take a minute to compile


@pytest.fixture(scope="module")
def forms():
    return {solver: ladder(4, solver) for solver in ("full", "sparse")}


@pytest.fixture(scope="module")
def outcomes(forms):
    """Trajectory, gradient and second derivative by a factor of all masses."""

    def of(system, state):
        def run(scale):
            heavier = eqx.tree_at(lambda s: s.mass, system, system.mass * scale)
            return nc.simulate(heavier, state, dt=0.02, steps=8)

        def loss(scale):
            return jnp.sum(jnp.sin(scale * run(scale).q[-1]))

        gradient = jax.grad(loss)
        return jax.jit(lambda x: (run(x).q, gradient(x), jax.jvp(gradient, (x,), (1.0,))[1]))(1.3)

    return {solver: of(*given) for solver, given in forms.items()}


def test_one_trajectory(outcomes):
    dense, sparse = (np.asarray(outcomes[s][0]) for s in ("full", "sparse"))
    assert np.max(np.abs(dense[-1] - dense[0])) > 0.05
    assert np.max(np.abs(dense - sparse)) <= tol.SAME_TRAJECTORY


def test_one_gradient_forward_over_reverse_too(outcomes):
    for k in (1, 2):
        dense, sparse = (float(outcomes[s][k]) for s in ("full", "sparse"))
        assert abs(dense - sparse) <= tol.SAME_GRADIENT * abs(dense)


def test_the_report_names_it(forms):
    system, _ = forms["sparse"]
    assert f"sparse, {system.sparsity.plan.name} (" in system.report()
    assert forms["full"][0].sparsity is None


def test_large_loops_are_sparse_unless_constraints_depend_on_each_other():
    assert ladder(8, None)[0].structure.solver == "sparse"
    doubled, _ = ladder(8, None, rods=2)
    assert doubled.structure.solver == "full" and doubled.structure.redundant


SECTION = dict(EA=1e4, GA=5e3, EI=2.0, GJ=1.5, density=1.0, rotary=1e-3)


def frame_of_beams(solver: str):
    """A portal of three beams, clamped at both feet and pushed sideways at a node within."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    section = nc.Section.of_numbers(**SECTION)
    feet = ((0.0, 0.0), (1.0, 0.2))
    posts = [
        scene.add(nc.Beam(section, [(*foot, 0.0), (*foot, 1.0)], elements=4, start=nc.ground))
        for foot in feet
    ]
    bar = scene.add(nc.Beam(section, [(*foot, 1.0) for foot in feet], elements=4, start=posts[0].end))
    scene.add(nc.Fixed(posts[1].end, bar.end))
    pushed = nc.Point(posts[0].at(0.5), (*feet[0], 0.5))
    scene.add(nc.PointForce((pushed,), force=lambda t: jnp.array([2.0, 6.0, 0.0])))
    return *scene.compile(solver=solver), bar


def test_frames_of_beams_move_alike():
    """Could go wrong: what couples nodes of several beams is missing in the pattern of the Jacobian."""
    paths = {}
    for solver in ("full", "sparse"):
        system, state, bar = frame_of_beams(solver)
        trajectory = nc.simulate(system, state, dt=5e-3, steps=40)
        assert float(nc.balance(system, trajectory).energy.max()) <= tol.ENERGY
        paths[solver] = np.asarray(system.sense(trajectory, bar.end).position)
    assert "sparse, multifrontal" in system.report()
    assert np.max(np.abs(paths["full"] - paths["full"][0])) > 0.01
    assert np.max(np.abs(paths["full"] - paths["sparse"])) <= 1e-10


@pytest.mark.parametrize("scheme", [nc.EnergyMomentum(order=4), nc.Dissipative(), nc.VariationalMidpoint()])
def test_a_mesh_that_is_solved_densely_warns(scheme):
    scene = nc.Scene()
    metal = nc.Elastic(E=1e6, nu=0.3, density=1e3)
    scene.add(nc.Solid(nc.mesh.box((1, 0.25, 0.25), (20, 3, 3)), material=metal))
    system, state = scene.compile()

    def run(scheme):
        jax.eval_shape(lambda: nc.simulate(system, state, dt=1e-3, steps=1, scheme=scheme, throw=False))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(nc.EnergyMomentum())
    with pytest.warns(UserWarning, match=r"solves the (1008|2016) unknowns of a step densely"):
        run(scheme)
