"""Sparse linear solvers against dense ones: every structure, both directions, every mode of derivative."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import patterns
from benchmarks.fronts import fronts
from natcoord_jax.linsolve import symbolic
from natcoord_jax.linsolve.blocks import block_pattern
from natcoord_jax.linsolve.conjugate_residuals import conjugate_residuals
from natcoord_jax.linsolve.graph import graph_of
from natcoord_jax.linsolve.ordering import dissection, rounds
from natcoord_jax.linsolve.pivot_analysis import pivot_order
from natcoord_jax.linsolve.sparse import SparseSolver, choose, factorised

# Solutions of well-conditioned systems by two eliminations.
SAME_SOLUTION = 1e-10
# Residual after one refinement, relative to the terms of each row: a few roundings.
REFINED = 1e-12

SYSTEMS = {
    "ring": patterns.ring(10),
    "chain": patterns.chain(16),
    "short chain": patterns.chain(3, 5),
    "body chain": patterns.body_chain(20),
    "body tree": patterns.body_tree(15),
    "ladder": patterns.ladder(9),
    "frame": patterns.frame(5, 6),
    "shell 4": patterns.shell(4, 4),
    "shell 8, hinged": patterns.shell(8, 8, hinged=True),
}
CHAINS = {"chain", "body chain"}


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


@pytest.fixture(scope="module")
def cases():
    made = {}

    def get(key, name=None):
        if (key, name) not in made:
            made[key, name] = Case(SYSTEMS[key], name)
        return made[key, name]

    return get


def backward_error(dense, x, b):
    """Largest residual relative to the sum of the absolute terms of its row."""
    return np.max(np.abs(dense @ x - b) / (np.abs(dense) @ np.abs(x) + np.abs(b)))


@jax.jit
def both(plan, matrix, right):
    factors = factorised(plan, matrix)
    return factors.solve(right), factors.transpose().solve(right)


@jax.jit
def solve(plan, matrix, right):
    return SparseSolver.of(plan, matrix).solve(right)


@pytest.mark.parametrize("key", SYSTEMS)
def test_products_agree_with_dense(cases, key):
    case = cases(key)
    np.testing.assert_array_equal(case.matrix.to_dense(), case.dense)
    for found, expected in (
        (case.matrix.multiply(case.right), case.dense @ case.right),
        (case.matrix.multiply_transposed(case.right), case.dense.T @ case.right),
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(case.dense).sum(1).max())


@pytest.mark.parametrize("key", SYSTEMS)
def test_fronts_agree_with_dense(cases, key):
    case = cases(key, "multifrontal")
    x, transposed = both(case.plan, case.matrix, case.right)
    for found, matrix in ((x, case.dense), (transposed, case.dense.T)):
        expected = np.linalg.solve(matrix, case.right)
        np.testing.assert_allclose(found, expected, rtol=0, atol=SAME_SOLUTION * np.abs(expected).max())


@pytest.mark.parametrize("key", sorted(CHAINS))
def test_chains_agree_with_dense(cases, key):
    case = cases(key)
    assert case.plan.name == "block tridiagonal"
    x, transposed = both(case.plan, case.matrix, case.right)
    for found, matrix in ((x, case.dense), (transposed, case.dense.T)):
        expected = np.linalg.solve(matrix, case.right)
        np.testing.assert_allclose(found, expected, rtol=0, atol=SAME_SOLUTION * np.abs(expected).max())


def test_structure_chooses_the_solver(cases):
    names = {key: cases(key).plan.name for key in ("short chain", "chain", "body tree", "ring", "shell 4")}
    assert names == {
        "short chain": "dense",
        "chain": "block tridiagonal",
        "body tree": "multifrontal",
        "ring": "multifrontal",
        "shell 4": "multifrontal",
    }
    with pytest.raises(ValueError, match="no chain"):
        cases("ring", "block tridiagonal")
    with pytest.raises(ValueError, match="no solver"):
        cases("ring", "lu")


def test_an_order_of_pivots_serves_all_matrices():
    """Exchanged rows would suit the first alone better, but have pivots of zero in the second."""
    weak, other = np.array([[1.1e-9, 0.7], [1.3, 0.2]]), np.eye(2)
    crossed = np.array([[0.0, 1.0], [1.0, 0.0]])
    assert pivot_order(weak[None])[0].tolist() == [1, 0]
    rows, inverses = pivot_order(np.stack([weak, other]))
    assert rows.tolist() == [0, 1]
    np.testing.assert_allclose(inverses @ np.stack([weak, other]), np.stack([np.eye(2)] * 2), atol=1e-6)
    assert pivot_order(np.stack([crossed, other]))[1] is None


def test_an_unknown_without_an_element_is_refused():
    with pytest.raises(ValueError, match=r"unknowns \[2\] are in no element"):
        block_pattern(np.arange(3), [np.array([[0, 1]])])


def test_what_is_fixed_is_dropped():
    """A spring to the ground, unknown number n, adds to the diagonal alone."""
    pattern, _ = block_pattern(np.arange(2), [np.array([[0, 1], [1, 2]])])
    matrix = pattern.assemble(jnp.tile(jnp.array([[1.0, -1.0], [-1.0, 1.0]]), (2, 1, 1)))
    np.testing.assert_array_equal(matrix.to_dense(), [[1, -1], [-1, 2]])


@pytest.mark.parametrize("name", ["block tridiagonal", "multifrontal"])
@pytest.mark.parametrize("kind", ["beams", "joints"])
def test_mass_ratio_of_1e8_along_a_chain(kind, name):
    build = patterns.chain if kind == "beams" else patterns.body_chain
    case = Case(build(32, ratio=1e-8), name)
    assert backward_error(case.dense, solve(case.plan, case.matrix, case.right), case.right) <= REFINED


@pytest.mark.parametrize(("key", "name"), [("ladder", None), ("chain", None), ("short chain", None)])
def test_derivatives_agree_with_dense(cases, key, name):
    """By the right-hand side and by the numbers of the matrix: forward, reverse, forward over reverse."""
    case = cases(key, name)
    random = np.random.default_rng(3)
    along = jnp.asarray(random.standard_normal(case.system.size))
    weights = [jnp.asarray(random.uniform(0.5, 1.5, m.shape)) for m in case.locals]

    def matrix_at(scale):
        return case.pattern.assemble(*(m * (1.0 + scale * w) for m, w in zip(case.locals, weights)))

    def sparse(scale, right):
        return jnp.sin(SparseSolver.of(case.plan, matrix_at(scale)).solve(right)) @ along

    def dense(scale, right):
        return jnp.sin(jnp.linalg.solve(matrix_at(scale).to_dense(), right)) @ along

    at, tangent = (jnp.array(0.1), case.right), (jnp.array(1.0), along)
    results = []
    for f in (sparse, dense):
        gradient = jax.grad(f, argnums=(0, 1))
        every = jax.jit(
            lambda f=f, g=gradient: (f(*at), g(*at), jax.jvp(f, at, tangent), jax.jvp(g, at, tangent))
        )
        results.append(jax.tree.leaves(every()))
    for found, expected in zip(*results, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * float(np.abs(expected).max()))


@pytest.mark.parametrize("key", ["chain", "ladder"])
def test_batches_of_gradients(cases, key):
    case = cases(key)

    def f(scale):
        matrix = case.pattern.assemble(*(scale * m for m in case.locals))
        return jnp.sum(SparseSolver.of(case.plan, matrix).solve(case.right))

    scales = jnp.array([0.5, 1.0, 4.0])
    found = jax.jit(jax.vmap(jax.grad(f)))(scales)
    np.testing.assert_allclose(found, -jnp.sum(jax.jit(jax.vmap(f))(jnp.ones(3))) / 3 / scales**2, rtol=1e-9)


@pytest.mark.parametrize("key", ["chain", "ladder"])
def test_a_singular_matrix_is_reported(cases, key):
    """One unknown loses its equation; in a batch, the other lane does not notice."""
    case = cases(key)

    @jax.jit
    def report(plan, matrix, right):
        solver = SparseSolver.of(plan, matrix)
        return solver.singular(solver.solve(right), right)

    assert not report(case.plan, case.matrix, case.right)
    tiles = jnp.where((case.pattern.rows == 7)[:, :, None], 0.0, case.matrix.tiles)
    assert report(case.plan, type(case.matrix)(case.pattern, tiles), case.right)
    lanes = jax.vmap(lambda t: report(case.plan, type(case.matrix)(case.pattern, t), case.right))
    np.testing.assert_array_equal(lanes(jnp.stack([tiles, case.matrix.tiles])), [True, False])


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
    solver = SparseSolver.of(case.plan, case.matrix)
    assert solver.singular(solver.solve(case.right), case.right)


def test_a_bad_pivot_block_is_merged_into_its_parent():
    """Nodes whose own block is zero: invertible only together with the next ones."""
    count, width = 12, 4
    number = np.arange(2 * count * width).reshape(count, 2 * width)
    random = np.random.default_rng(5)
    local = np.zeros((count, 2 * width, 2 * width))
    local[:, :width, width:] = np.eye(width) + 0.1 * random.standard_normal((count, width, width))
    local[:, width:, :width] = -local[:, :width, width:].transpose(0, 2, 1)
    links = np.concatenate([number[:-1, width:], number[1:, width:]], axis=1)
    system = patterns.SparseSystem(
        "zero blocks",
        np.repeat(np.arange(2 * count), width),
        (number, links),
        (local, random.standard_normal((count - 1, 2 * width, 2 * width)) / 4),
    )
    case = Case(system, "multifrontal")
    x = solve(case.plan, case.matrix, case.right)
    assert backward_error(case.dense, x, case.right) <= REFINED


def test_levels_grow_with_the_logarithm():
    """Rounds of independent nodes and dissection: twice the system, a level or two more."""
    for build in (patterns.chain, patterns.body_tree, patterns.body_chain):
        depth = []
        for count in (63, 127, 255):
            system = build(count)
            graph = graph_of(block_pattern(system.nodes, list(system.elements))[1])
            for groups in (rounds(graph.neighbours), dissection(graph.neighbours, graph.weights, 24)):
                depth.append(symbolic.depths(symbolic.fronts_of(graph, groups)).max())
        assert max(depth[2:4]) <= max(depth[:2]) + 3 and max(depth) <= 20, (build.__name__, depth)


def test_too_many_levels_are_refused():
    system = patterns.chain(symbolic.MOST_LEVELS + 1)
    graph = graph_of(block_pattern(system.nodes, list(system.elements))[1])
    one_by_one = [[v] for v in range(len(graph.members))]
    with pytest.raises(AssertionError, match="65 levels"):
        symbolic.depths(symbolic.fronts_of(graph, one_by_one))


def test_numbers_do_not_retrace_and_structure_does():
    traced = []

    @jax.jit
    def counted(plan, matrix, right):
        traced.append(plan.name)
        return factorised(plan, matrix).solve(right)

    first, same, other = (Case(patterns.ladder(n), "multifrontal") for n in (6, 6, 7))
    counted(first.plan, first.matrix, first.right)
    changed = same.pattern.assemble(*(2.0 * m for m in same.locals))
    np.testing.assert_allclose(
        2.0 * counted(same.plan, changed, same.right), counted(first.plan, first.matrix, first.right)
    )
    assert len(traced) == 1 and hash(first.pattern.digest) == hash(same.pattern.digest)
    counted(other.plan, other.matrix, other.right)
    assert len(traced) == 2 and other.pattern.digest != first.pattern.digest
    # Indices are arguments: no array of them is baked into the program.
    text = counted.lower(first.plan, first.matrix, first.right).as_text()
    assert len(text) < 400_000


# An operator that is only applied.


def nearly_identity(size: int, rank: int):
    """A nonsymmetric matrix that differs from the identity by a few large directions, and a right side."""
    make = np.random.default_rng(1)
    matrix = np.eye(size) + make.normal(size=(size, rank)) @ make.normal(size=(rank, size)) / size
    return matrix, make.normal(size=size)


@pytest.mark.parametrize("limit", [3, 5])
def test_conjugate_residuals_solve_in_as_many_directions_as_differ(limit):
    """One for each direction that differs, and one more; less leaves something, and says so."""
    matrix, right = nearly_identity(30, 4)

    def apply(x, level, seen):
        return {"x": matrix @ x["x"] - level * seen[0] * right}, 2.0 * x["x"][:3] + level

    start, half, yes = {"x": jnp.ones(30)}, {"x": jnp.full(30, 0.5)}, jnp.array(True)
    found = conjugate_residuals(
        apply, half, yes, start, jnp.zeros(3), start, lambda r: jnp.array(1e-12), limit
    )
    np.testing.assert_array_equal(found.found, 1.0)  # of what is seen, which what is solved depends on
    left = np.linalg.norm(matrix @ found.solution["x"] - right) / np.linalg.norm(matrix @ np.ones(30) - right)
    assert float(found.left) == pytest.approx(left, rel=1e-6, abs=1e-13)
    assert int(found.count) == limit
    assert bool(found.there) == (limit == 5) == bool(left <= 1e-12)
    # What comes along belongs to the solution, affine as it is.
    np.testing.assert_allclose(found.more, 2.0 * found.solution["x"][:3] + 1.0, rtol=1e-10)


@pytest.mark.parametrize(("shape", "row"), [
    ((32, 32), "| plate 32 × 32 | 5 445 | 10 MB | 0.24 Gflop | 250 |"),
    ((8, 8, 8), "| block 8 × 8 × 8 | 2 187 | 7 MB | 0.25 Gflop | 351 |"),
])  # fmt: skip
def test_what_fronts_hold_is_what_the_page_says(shape, row):
    text = (Path(__file__).resolve().parents[1] / "docs/howto/large_systems.md").read_text("utf-8")
    found = fronts(shape)
    assert row in text
    cells = row.strip("| ").split(" | ")[1:]
    told = [float("".join(c for c in cell if c.isdigit() or c == ".")) for cell in cells]
    own = found["unknowns"], 1e-6 * found["factors"], 1e-9 * found["operations"], found["largest"]
    np.testing.assert_allclose(told, own, rtol=0.06)


@pytest.mark.parametrize("shape", [(32, 32), (24, 6, 6)])
def test_plans_of_meshes_compile_in_time(shape):
    """A batch of fronts takes about half a second of the compiler, and another to be differentiated."""
    assert fronts(shape)["batches"] <= 20
