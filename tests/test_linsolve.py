"""One contract for all linear solvers: both directions, every mode of derivative, what is singular is said.

Structures are a table, numbers are lanes; dense solutions of LAPACK are the reference.
"""

from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
from benchmarks import patterns
from benchmarks.fronts import fronts
from natcoord_jax.linsolve.blocks import block_pattern
from natcoord_jax.linsolve.dense import Inverse
from natcoord_jax.linsolve.learning import across, learnt
from natcoord_jax.linsolve.sparse import SparseSolver, choose, factorised
from natcoord_jax.linsolve.stages import stagewise_inverse

# Residual after one refinement, relative to the terms of each row: a few roundings.
REFINED = 1e-12


def zero_blocks():
    """Nodes whose blocks are zero: invertible only with the next ones, so that they join these."""
    count, width = 12, 4
    number = np.arange(2 * count * width).reshape(count, 2 * width)
    random = np.random.default_rng(5)
    local = np.zeros((count, 2 * width, 2 * width))
    local[:, :width, width:] = np.eye(width) + 0.1 * random.standard_normal((count, width, width))
    local[:, width:, :width] = -local[:, :width, width:].transpose(0, 2, 1)
    links = np.concatenate([number[:-1, width:], number[1:, width:]], axis=1)
    return patterns.SparseSystem(
        "zero blocks",
        np.repeat(np.arange(2 * count), width),
        (number, links),
        (local, random.standard_normal((count - 1, 2 * width, 2 * width)) / 4),
    )


# Structure, solver to choose or None, and the one that suits it.
SYSTEMS = {
    "short chain": (lambda: patterns.chain(3, 5), None, "dense"),
    "chain": (lambda: patterns.chain(16), None, "block tridiagonal"),
    "ladder": (lambda: patterns.ladder(5), None, "multifrontal"),
    "body chain": (lambda: patterns.body_chain(20), None, "block tridiagonal"),
    "chain by fronts": (lambda: patterns.chain(16), "multifrontal", "multifrontal"),
    "ring": (lambda: patterns.ring(10), None, "multifrontal"),
    "body tree": (lambda: patterns.body_tree(15), None, "multifrontal"),
    "frame": (lambda: patterns.frame(5, 6), None, "multifrontal"),
    "shell 4": (lambda: patterns.shell(4, 4), None, "multifrontal"),
    "shell 8, hinged": (lambda: patterns.shell(8, 8, hinged=True), None, "multifrontal"),
    "zero blocks": (zero_blocks, "multifrontal", "multifrontal"),
}
DEFAULT, SLOW = ("short chain", "ladder"), ("chain", "body tree")


def lane_of(key):
    if key in DEFAULT:
        return key
    return pytest.param(key, marks=pytest.mark.slow if key in SLOW else pytest.mark.exhaustive)


class Case:
    """A system with its solver, its dense matrix and a right-hand side."""

    def __init__(self, system, name=None):
        self.system = system
        self.pattern, self.entries = block_pattern(system.nodes, list(system.elements))
        self.locals = tuple(map(jnp.asarray, system.matrices))
        self.matrix = self.pattern.assemble(*self.locals)
        self.plan = choose(
            self.pattern, self.entries, matrices=[self.matrix], coordinates=system.coordinates, name=name
        )
        self.dense = system.dense()
        self.right = jnp.asarray(np.random.default_rng(7).standard_normal(system.size))


@cache
def case_of(key):
    make, name, _ = SYSTEMS[key]
    return Case(make(), name)


def in_every_mode(loss, at, along):
    """Value, gradient, derivative along a direction, and that of the gradient."""
    gradient = jax.grad(loss, argnums=(0, 1))
    return jax.jvp(loss, at, along), jax.jvp(gradient, at, along)


@pytest.mark.parametrize("key", [lane_of(key) for key in SYSTEMS])
def test_all_is_as_of_the_dense_matrix(key):
    """Products and solutions in both directions, derivatives by the numbers of matrix and right-hand side."""
    case = case_of(key)
    assert case.plan.name == SYSTEMS[key][2]
    np.testing.assert_array_equal(case.matrix.to_dense(), case.dense)
    random = np.random.default_rng(3)
    along = jnp.asarray(random.standard_normal(case.system.size))
    weights = [jnp.asarray(random.uniform(0.5, 1.5, m.shape)) for m in case.locals]
    right = case.right

    def matrix_at(scale):
        return case.pattern.assemble(*(m * (1.0 + scale * w) for m, w in zip(case.locals, weights)))

    def sparse(scale):
        def loss(scale, right):
            return jnp.sin(SparseSolver.of(case.plan, matrix_at(scale)).solve(right)) @ along

        matrix = matrix_at(scale)
        factors = factorised(case.plan, matrix)
        products = matrix.multiply(right), matrix.multiply_transposed(right)
        solutions = factors.solve(right), factors.transpose().solve(right)
        return products, solutions, in_every_mode(loss, (scale, right), (jnp.array(1.0), along))

    def dense(scale):
        def loss(scale, right):
            return jnp.sin(jnp.linalg.solve(matrix_at(scale).to_dense(), right)) @ along

        matrix = matrix_at(scale).to_dense()
        solutions = jnp.linalg.solve(matrix, right), jnp.linalg.solve(matrix.T, right)
        derivatives = in_every_mode(loss, (scale, right), (jnp.array(1.0), along))
        return (matrix @ right, right @ matrix), solutions, derivatives

    scales = jnp.array([0.0, 0.1, 0.4])
    answers, references = (jax.jit(jax.vmap(f))(scales) for f in (sparse, dense))
    bounds = 1e-13, tol.SAME_SOLUTION, tol.SAME_GRADIENT
    for part, reference, bound in zip(answers, references, bounds, strict=True):
        for one, other in zip(jax.tree.leaves(part), jax.tree.leaves(reference), strict=True):
            np.testing.assert_allclose(one, other, rtol=0, atol=bound * float(np.abs(other).max()))


def refined_error(case):
    """Largest residual of a refined solution, in terms of the absolute terms of its row."""
    solved = jax.jit(lambda right: SparseSolver.of(case.plan, case.matrix).solve(right))
    x, b, dense = solved(case.right), case.right, case.dense
    return np.max(np.abs(dense @ x - b) / (np.abs(dense) @ np.abs(x) + np.abs(b)))


@pytest.mark.parametrize(
    "build, name",
    [
        (patterns.chain, "block tridiagonal"),
        *(
            pytest.param(*pair, marks=pytest.mark.exhaustive)
            for pair in (
                (patterns.body_chain, "multifrontal"),
                (patterns.chain, "multifrontal"),
                (patterns.body_chain, "block tridiagonal"),
            )
        ),
    ],
)
def test_mass_ratio_of_1e8_along_a_chain(build, name):
    assert refined_error(Case(build(32, ratio=1e-8), name)) <= REFINED


def test_what_cannot_be_solved_so_is_refused():
    ring = Case(patterns.ring(10))
    options = dict(matrices=[ring.matrix], coordinates=ring.system.coordinates)
    with pytest.raises(ValueError, match="no chain"):
        choose(ring.pattern, ring.entries, name="block tridiagonal", **options)
    with pytest.raises(ValueError, match="no solver"):
        choose(ring.pattern, ring.entries, name="lu", **options)
    with pytest.raises(ValueError, match=r"unknowns \[2\] are in no element"):
        block_pattern(np.arange(3), [np.array([[0, 1]])])


def test_what_is_fixed_is_dropped():
    """A spring to the ground, unknown number n, adds to the diagonal alone."""
    pattern, _ = block_pattern(np.arange(2), [np.array([[0, 1], [1, 2]])])
    matrix = pattern.assemble(jnp.tile(jnp.array([[1.0, -1.0], [-1.0, 1.0]]), (2, 1, 1)))
    np.testing.assert_array_equal(matrix.to_dense(), [[1, -1], [-1, 2]])


@jax.jit
def is_singular(plan, matrix, right):
    solver = SparseSolver.of(plan, matrix)
    return solver.singular(solver.solve(right), right)


@pytest.mark.parametrize("key", ["chain", pytest.param("ladder", marks=pytest.mark.exhaustive)])
def test_a_singular_matrix_is_reported(key):
    """One unknown loses its equation; in a batch, the other lane does not notice."""
    case = case_of(key)
    tiles = jnp.where((case.pattern.rows == 7)[:, :, None], 0.0, case.matrix.tiles)
    lanes = jax.vmap(lambda t: is_singular(case.plan, type(case.matrix)(case.pattern, t), case.right))
    np.testing.assert_array_equal(lanes(jnp.stack([tiles, case.matrix.tiles])), [True, False])


@pytest.mark.exhaustive
def test_dependent_constraints_are_reported():
    """The same joint twice: the matrix is singular without any zero row."""
    system = patterns.ladder(6)
    loop = [k for k, e in enumerate(system.elements) if e.shape[1] == 15][0]
    doubled = system.elements[loop][:1].copy()
    doubled[:, 12:] = system.size + np.arange(3)
    twice = patterns.SparseSystem(
        "twice",
        np.concatenate([system.nodes, system.nodes[system.elements[loop][0, 12:]]]),
        (*system.elements, doubled),
        (*system.matrices, system.matrices[loop][:1]),
    )
    case = Case(twice, "multifrontal")
    assert is_singular(case.plan, case.matrix, case.right)


@pytest.mark.exhaustive
def test_numbers_do_not_retrace_and_structure_does():
    traced = []

    @jax.jit
    def counted(plan, matrix, right):
        traced.append(plan.name)
        return factorised(plan, matrix).solve(right)

    first, same, longer = (Case(patterns.ladder(n), "multifrontal") for n in (6, 6, 7))
    counted(first.plan, first.matrix, first.right)
    changed = same.pattern.assemble(*(2.0 * m for m in same.locals))
    np.testing.assert_allclose(
        2.0 * counted(same.plan, changed, same.right), counted(first.plan, first.matrix, first.right)
    )
    structures = [jax.tree.structure((case.pattern, case.plan)) for case in (first, same, longer)]
    assert len(traced) == 1 and hash(structures[0]) == hash(structures[1]) and structures[0] == structures[1]
    # What is written into the program does not grow with what elimination fills in.
    text = counted.lower(first.plan, first.matrix, first.right).as_text()
    assert len(text) < 400_000
    counted.lower(longer.plan, longer.matrix, longer.right)
    assert len(traced) == 2 and structures[2] != structures[0]


@pytest.mark.parametrize(("shape", "row"), [
    ((32, 32), "| plate 32 × 32 | 5 445 | 10 MB | 0.24 Gflop | 250 |"),
    ((8, 8, 8), "| block 8 × 8 × 8 | 2 187 | 7 MB | 0.25 Gflop | 351 |"),
])  # fmt: skip
def test_fronts_are_as_large_as_the_page_says(shape, row):
    """And few: a batch of them takes half a second of the compiler, and another to be differentiated."""
    text = (Path(__file__).resolve().parents[1] / "docs/howto/large_systems.md").read_text("utf-8")
    size = fronts(shape)
    assert row in text
    cells = row.strip("| ").split(" | ")[1:]
    numbers = [float("".join(c for c in cell if c.isdigit() or c == ".")) for cell in cells]
    actual = size["unknowns"], 1e-6 * size["factors"], 1e-9 * size["operations"], size["largest"]
    np.testing.assert_allclose(numbers, actual, rtol=0.06)
    assert size["batches"] <= 20


# --- dense inverses ----------------------------------------------------------------------------------------


def parts(balances, constraints):
    """N, D and K of random numbers, with the signs of inertia and constraints."""
    rng, size = np.random.default_rng(0), balances + constraints
    inertia, damping, stiffness = np.zeros((3, size, size))
    root, rows = rng.normal(size=(balances, balances)), rng.normal(size=(constraints, balances))
    inertia[:balances, :balances] = root @ root.T + balances * np.eye(balances)
    damping[:balances, :balances] = rng.normal(size=(balances, balances))
    damping[:balances, balances:], damping[balances:, :balances] = -rows.T, rows
    stiffness[:, :balances] = rng.normal(size=(size, balances))
    return inertia, damping, stiffness


@pytest.mark.parametrize(
    "order, balances, constraints",
    [
        (4, 5, 2),
        *(pytest.param(n, b, c, marks=pytest.mark.exhaustive) for n, b, c in ((6, 5, 0), (10, 50, 3))),
    ],
)
def test_inverses_of_the_matrix_of_all_stages(order, balances, constraints):
    """Of sum over stages of inertia, damping and stiffness, one complex inverse for two stages."""
    tableau = nc.EnergyMomentum(order).tableau
    inertia, damping, stiffness = parts(balances, constraints)
    unit = np.eye(tableau.stages)
    matrix = np.kron(tableau.a_inverse, inertia) + np.kron(unit, damping)
    matrix += np.kron(np.array(tableau.a), stiffness)
    numbers = *map(jnp.asarray, (inertia, damping, stiffness)), jnp.diagonal(inertia)[:balances]
    inverse = np.asarray(jax.jit(lambda *x: stagewise_inverse(*x, tableau))(*numbers)).reshape(matrix.shape)
    # Without constraints exact; with them, but for the diagonal that redundant rows need.
    np.testing.assert_allclose(inverse @ matrix, np.eye(len(matrix)), atol=1e-7 if constraints else 1e-11)


@pytest.mark.parametrize("size", [6, *(pytest.param(n, marks=pytest.mark.exhaustive) for n in (1, 3))])
def test_inverses_that_learn_solve_in_one_correction_more_than_unknowns(size):
    """Could go wrong: an update that spoils what was learnt before; things learnt of what tells nothing."""
    rng = np.random.default_rng(0)
    matrix = np.eye(size) + 0.2 * rng.normal(size=(size, size))
    near = np.linalg.inv(matrix) @ (np.eye(size) + 0.1 * rng.normal(size=(size, size)))
    right, weights = rng.normal(size=size), jnp.arange(1.0, size + 1.0)

    @jax.jit
    def corrections(matrix, inverse, right):
        solver, x, last, news = Inverse(inverse), *(jnp.zeros(size) for _ in range(3))
        basis, steps = jnp.zeros((size, size)), []
        for k in range(size + 1):
            change = solver.solve(right - matrix @ x)
            solver, change, _ = learnt(solver, last, change, weights, jnp.array(k > 0), news)
            basis = jnp.concatenate([news[None], basis[:-1]]) if k else basis
            news = across(basis, change, weights)
            x, last = x + change, change
            steps.append(change)
        taught = jnp.stack([solver.solve(matrix @ step) for step in steps[:-1]])
        nothing = [
            learnt(solver, before, after, weights, jnp.array(telling))[2]
            for before, after, telling in (
                (right, 0.1 * right, False),
                (0.0 * right, 0.1 * right, True),
                (right, -2.0 * right, True),
                (right, jnp.nan * right, True),
            )
        ]
        return x, taught, jnp.stack(steps[:-1]), jnp.array(nothing)

    x, taught, steps, nothing = corrections(*map(jnp.asarray, (matrix, near, right)))
    np.testing.assert_allclose(matrix @ x, right, atol=1e-12)
    np.testing.assert_allclose(taught, steps, rtol=1e-7, atol=1e-12)
    assert not np.any(nothing)
