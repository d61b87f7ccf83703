"""What the constraints of loops and drives admit at one configuration.

Could go wrong: redundant rows that spoil the basis, a weakest direction that is left out where none should
be, impulses of drives that do not belong to their rates, a rotation of subspaces that stops too soon, or
whose derivative does.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.direct_rotation import nearest_orthogonal
from natcoord_jax.mechanics.block_tangent_space import tangents_at
from natcoord_jax.mechanics.equations_of_motion import constraint_matrix
from natcoord_jax.mechanics.momentum import inertia_alone, spatial_inertia, wrench
from natcoord_jax.mechanics.reduced import ReducedStep, at_rest
from natcoord_jax.mechanics.start_cache import NOTHING
from natcoord_jax.mechanics.tangent_space import TangentSpace
from natcoord_jax.model.rows import row_rates


def driven_four_bar():
    """A redundant loop with a crank that is driven, and a gear between two of its joints."""
    scene = nc.Scene()
    bar = dict(mass=1.0, inertia=(0.01, 0.1, 0.1))
    crank = scene.add(nc.RigidBody(**bar, position=(0.0, 0.5, 0.0)))
    coupler = scene.add(nc.RigidBody(**bar, position=(0.5, 1.0, 0.0)))
    rocker = scene.add(nc.RigidBody(**bar, position=(1.0, 0.5, 0.0)))
    ends = [(nc.ground, crank, (0, 0, 0)), (crank, coupler, (0, 1, 0)), (coupler, rocker, (1, 1, 0))]
    joints = [scene.add(nc.Revolute(a, b, point=p, axis=(0, 0, 1))) for a, b, p in ends]
    joints.append(scene.add(nc.Revolute(nc.ground, rocker, point=(1, 0, 0), axis=(0, 0, 1))))
    scene.add(nc.Drive(joints[0], function=lambda t: 0.3 * t))
    return scene.compile()


def scenes():
    for name in ("four_bar", "bricard", "slider_crank"):
        example = gallery.load(name)
        yield name, example.system, example.state
    yield "driven", *driven_four_bar()


LONG = "bricard", "slider_crank"


@pytest.fixture(
    scope="module", params=["four_bar", "driven", *(pytest.param(x, marks=pytest.mark.slow) for x in LONG)]
)
def scene(request):
    system, state = next((system, state) for name, system, state in scenes() if name == request.param)
    moved = nc.simulate(system, state, dt=0.01, steps=5)
    return system, jax.tree.map(lambda x: x[-1], moved.states)


def test_constraints_of_a_step_at_rest_are_those_of_an_instant(scene):
    system, state = scene
    inputs = jnp.zeros(len(system.structure.inputs))
    count, rest = system.structure.unknowns, jnp.zeros(system.structure.multipliers)

    def constraints(w):
        step = at_rest(ReducedStep.prepare(system, state, inputs, jnp.zeros(()), gauss(1), NOTHING))
        return step.residual(jnp.concatenate([w, rest]))[0][count:]

    rows = jax.jit(jax.jacfwd(constraints))(jnp.zeros(count))
    np.testing.assert_allclose(constraint_matrix(system, state), rows, atol=1e-13)


def test_subspaces_are_those_of_singular_vectors(scene):
    system, state = scene
    matrix, known = np.asarray(constraint_matrix(system, state)), TangentSpace.at(system, state).admissible
    framed = matrix @ np.asarray(known.frame).T
    rank = system.structure.rank or matrix.shape[0]
    left, sizes, right = np.linalg.svd(framed)
    assert rank == len(sizes) or sizes[rank] < 1e-12 * sizes[0]
    allowed = np.eye(framed.shape[1]) - right[:rank].T @ right[:rank]
    np.testing.assert_allclose(known.subspace, allowed, atol=1e-12)
    if known.range is None:
        assert system.structure.rank is None
    else:
        np.testing.assert_allclose(known.range, left[:, :rank] @ left[:, :rank].T, atol=1e-12)
    lift = np.asarray(known.frame).T @ np.linalg.pinv(framed, rcond=1e-9)
    np.testing.assert_allclose(known.lift, lift, atol=1e-11 * np.max(np.abs(lift)))


def test_momenta_of_bodies_are_those_of_their_rows(scene):
    # Also between two configurations, with a centre of mass that is not the reference point.
    system, state = scene
    rng = np.random.default_rng(5)
    rows, others = (jnp.asarray(rng.normal(size=(3, 4, 3))) for _ in range(2))
    root = rng.normal(size=(3, 4, 4))
    mass = jnp.asarray(root @ root.swapaxes(1, 2))
    velocity, spin = (jnp.asarray(rng.normal(size=(3, 3))) for _ in range(2))
    moved = inertia_alone(mass, row_rates(others, velocity, spin))
    expected = jnp.concatenate([x[0] for x in wrench(moved[None], rows[None, :, 1:])], axis=1)
    bodies = spatial_inertia(mass, rows[:, 1:], others[:, 1:])
    found = jnp.einsum("bij,bj->bi", bodies, jnp.concatenate([velocity, spin], axis=1))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    # And so are those of the free motions of a tree.
    space = TangentSpace.at(system, state)
    columns = [space.pulled(space.impulse(space.spread(unit))) for unit in jnp.eye(space.turning.shape[0])]
    np.testing.assert_allclose(space.inertia, jnp.stack(columns, axis=1), atol=1e-13)


def test_velocities_of_drives_are_those_prescribed():
    system, state = driven_four_bar()
    space = tangents_at(system, state)
    assert isinstance(space, TangentSpace) and space.admissible.lift is not None
    found = constraint_matrix(system, state) @ space.drift_rates
    np.testing.assert_allclose(found, space.admissible.prescribed, atol=1e-13)
    assert np.max(np.abs(np.asarray(found))) == pytest.approx(0.3)


def test_impulses_of_constraints_are_left_out_where_none_does_work():
    example = gallery.load("four_bar")
    plain, whole = tangents_at(example.system, example.state), TangentSpace.at(example.system, example.state)
    assert isinstance(plain, TangentSpace) and plain.admissible.lift is None
    np.testing.assert_array_equal(plain.admissible.subspace, whole.admissible.subspace)
    np.testing.assert_array_equal(plain.drift.rows, jnp.zeros_like(plain.rows))


def rotated(angle, size=5):
    """A matrix whose nearest orthogonal one is wanted, as of subspaces at an angle, and that one."""
    rng = np.random.default_rng(2)
    basis = np.linalg.qr(rng.normal(size=(size, size)))[0]
    turn = np.eye(size)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    projector = np.diag([1.0] + [0.0] * (size - 1))
    start, end = basis @ projector @ basis.T, basis @ turn @ projector @ turn.T @ basis.T
    unit = np.eye(size)
    return end @ start + (unit - end) @ (unit - start), basis @ turn @ basis.T


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.1, 0.7, 1.1])
def test_direct_rotations_are_orthogonal_and_have_all_derivatives(angle):
    matrix, expected = rotated(angle)
    found = nearest_orthogonal(jnp.asarray(matrix))
    np.testing.assert_allclose(found, expected, atol=2e-15)
    # Of the polar factor: dR = R W, W S + S W = R^T dX - dX^T R with S = R^T X.
    rng = np.random.default_rng(3)
    change, weights = rng.normal(size=matrix.shape), rng.normal(size=matrix.shape)
    skew = expected.T @ change - change.T @ expected
    stretch = expected.T @ matrix
    unit = np.eye(len(matrix))
    spin = np.linalg.solve(np.kron(unit, stretch) + np.kron(stretch.T, unit), skew.T.reshape(-1))
    exact = expected @ spin.reshape(skew.shape).T
    np.testing.assert_allclose(jax.jvp(nearest_orthogonal, (matrix,), (change,))[1], exact, atol=1e-12)
    gradient = jax.grad(lambda x: jnp.sum(weights * nearest_orthogonal(x)))(jnp.asarray(matrix))
    np.testing.assert_allclose(jnp.sum(gradient * change), np.sum(weights * exact), rtol=1e-11)
