"""The geometry of contacts: distances of shapes and facets, energies of overlaps, what a run tells."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_scenes import FLOOR, RUBBER, SHAPES, assert_never_gains

import natcoord_jax as nc

BOX = np.array([0.3, 0.5, 0.7])
CORNER = np.array([0.2, -0.3, 0.1])
OTHER = np.array([0.4, 0.6, 0.2])
GAPS = {
    # Gap, which of its markers are points, which of these are the second body's, and bodies of the others:
    # "a" points, "n" a direction of the plane, "0" and "1" the three axes of the first and second body.
    nc.SphereOnPlane: (nc.SphereOnPlane(radius=0.3), (0, 2), (2,), "ana"),
    nc.EllipsoidOnPlane: (nc.EllipsoidOnPlane(semi_axes=np.array([0.2, 0.3, 0.4])), (0, 2), (2,), "ana111"),
    nc.DiscOnPlane: (nc.DiscOnPlane(radius=0.3), (0, 2), (2,), "ana1"),
    nc.SphereOnSphere: (nc.SphereOnSphere(radii=np.array([0.2, 0.3])), (0, 1), (1,), "aa"),
    nc.CapsuleOnCapsule: (nc.CapsuleOnCapsule(radii=np.array([0.2, 0.3])), (0, 1, 2, 3), (2, 3), "aaaa"),
    nc.SphereOnBox: (nc.SphereOnBox(size=BOX, radius=0.2), (0, 1), (1,), "aa000"),
    nc.CornersOnBox: (nc.CornersOnBox(size=BOX, corner=CORNER, rounding=0.02), (0, 1), (1,), "aa000111"),
    nc.EdgesOnEdges: (
        nc.EdgesOnEdges(sizes=np.stack([BOX, OTHER]), skew=np.array([1.0, -1.0]), rounding=0.02),
        (0, 1),
        (1,),
        "aa000111",
    ),
}


def markers(kinds, random):
    """Places of points and directions, at random."""
    axes = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(3)]
    taken = {"n": iter(axes[2]), "0": iter(axes[0]), "1": iter(axes[1])}
    return np.stack([random.normal(size=3) if kind == "a" else next(taken[kind]) for kind in kinds])


@pytest.mark.slow
def test_gaps_do_not_know_of_axes_and_push_along_their_normal():
    """The same in other axes; its slope pushes the second body along the normal that it tells, no force and
    no torque in all."""
    public = [x for x in vars(nc).values() if isinstance(x, type) and issubclass(x, nc.Gap)]
    assert set(public) - {nc.Gap} == set(GAPS)
    for kind, (gap, points, second, kinds) in GAPS.items():
        measured = jax.jit(jax.value_and_grad(lambda x, gap=gap: gap.distance(gap.invariants(x))))
        random = np.random.default_rng(4)
        for _ in range(5):
            x = markers(kinds, random)
            turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
            turn = turn * np.sign(np.linalg.det(turn))
            point = np.isin(np.arange(len(x)), points)
            moved = x @ turn.T + point[:, None] * random.normal(size=3)
            distance, forces = map(np.asarray, measured(x))
            assert float(measured(moved)[0]) == pytest.approx(float(distance), abs=1e-13), kind
            assert np.abs(forces[point].sum(axis=0)).max() <= 1e-12, kind
            assert np.abs(np.cross(x, forces).sum(axis=0)).max() <= 1e-12, kind
            # (The nearest points of segments are drawn to their middles a little.)
            near = 2e-2 if kind in (nc.CapsuleOnCapsule, nc.EdgesOnEdges) else 1e-12
            _, normal = gap.contact(jnp.asarray(x))
            np.testing.assert_allclose(forces[list(second)].sum(axis=0), normal, atol=near, err_msg=str(kind))


def posed(system, state, names):
    """Compiled: the least gap of some contacts, by rows of all bodies, in lanes."""

    def least(q):
        at = nc.State(**{**vars(state), "q": q})
        return jnp.min(jnp.stack([jnp.min(system.sense(at, name).gap) for name in names]))

    return jax.jit(jax.vmap(least))


def skeleton(shape):
    """Points within a shape whose distance, less a radius, is that of its surface."""
    if isinstance(shape, nc.Sphere):
        return np.zeros((1, 3)), float(shape.radius)
    if isinstance(shape, nc.Capsule):
        z = np.linspace(-0.5, 0.5, 201)[:, None] * float(shape.length)
        return z * (0, 0, 1.0), float(shape.radius)
    size = np.asarray(shape.size)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 13)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid * size, 0.0


@pytest.mark.parametrize(
    "pair",
    [
        ("sphere", "sphere"),
        ("capsule", "capsule"),
        ("sphere", "box"),
        pytest.param(("sphere", "capsule"), marks=pytest.mark.exhaustive),
        pytest.param(("capsule", "box"), marks=pytest.mark.exhaustive),
    ],
    ids=", ".join,
)
def test_gaps_are_distances(pair):
    """Against the least of many points, in random and in parallel poses."""
    shapes, random, scene = [SHAPES[name] for name in pair], np.random.default_rng(0), nc.Scene()
    bodies = [
        scene.add(nc.RigidBody(shape=shape, density=1.0, position=(k, 0, 0)))
        for k, shape in enumerate(shapes)
    ]
    names = [handle.name for handle in scene.add(nc.Contact(*bodies, stiffness=1.0, name="gap"))]
    system, state = scene.compile()
    poses = []
    for k in range(60):
        axes = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(2)]
        axes = [a * np.sign(np.linalg.det(a)) for a in (axes if k % 3 else axes[:1] * 2)]
        places = np.zeros(3), random.uniform(0.35, 0.6) * axes[1][0] + 0.05 * random.normal(size=3)
        poses.append(np.concatenate([np.vstack([p, a]) for p, a in zip(places, axes)]))
    gaps = posed(system, state, names)(jnp.asarray(np.stack(poses)))
    for gap, rows in zip(np.asarray(gaps), np.stack(poses).reshape(-1, 2, 4, 3)):
        points = [skeleton(shape)[0] @ rows[k, 1:] + rows[k, 0] for k, shape in enumerate(shapes)]
        apart = np.linalg.norm(points[0][:, None] - points[1], axis=-1).min()
        exact = apart - sum(skeleton(shape)[1] for shape in shapes)
        assert exact - 0.02 <= gap <= exact + 1e-3


def test_energy_of_an_overlap():
    """Half k d^2, or two fifths k d^(5/2), of each contact, and of all of them."""
    for law, power, part in (("linear", 2.0, 0.5), ("hertz", 2.5, 0.4)):
        scene = nc.Scene()
        for k in range(2):
            ball = {"shape": nc.Sphere(0.1), "density": 1.0, "position": (k, 0, 0.09 - 0.02 * k)}
            ball = scene.add(nc.RigidBody(**ball))
            scene.add(nc.Contact(ball, FLOOR, stiffness=1e4, law=law, name=f"gap {k}"))
        system, state = scene.compile()
        stores = system.energy(state).stores
        for k, depth in enumerate((0.01, 0.03)):
            energy = part * 1e4 * depth**power
            assert float(stores[f"gap {k}"]) == pytest.approx(energy, rel=1e-12)
            assert float(system.sense(state, f"gap {k}").energy) == pytest.approx(energy, rel=1e-12)


# --- facets -------------------------------------------------------------------------------------------------

SQUARE = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)])
STRIP = np.concatenate([SQUARE, SQUARE[1:3] + (1.0, 0.0, 0.0)])
FACETS = np.array([(1, 2, 3, 4), (2, 5, 6, 3)])
ENDS = np.array([(1, 0, 1, 1), (1, 1, 1, 0)])


def above(corners, place=(0.5, 0.5, 1.0), velocity=(0, 0, 0), **options):
    """A point above facets that are at rest."""
    scene = nc.Scene()
    point = scene.add(nc.PointMass(mass=1.0, position=place, velocity=velocity, name="point"))
    fixed = tuple(nc.Point(nc.ground, x) for x in corners)
    scene.add(nc.NodeOnFacets((nc.Point(point), *fixed), **{"stiffness": 1e5, "name": "facets", **options}))
    return scene.compile()


def gaps_at(system, state, places):
    """Of the point at some places."""
    rows = jnp.zeros((len(places), *state.q.shape)) + state.q
    return np.asarray(posed(system, state, ["facets"])(rows.at[:, 0].set(jnp.asarray(places))))


@pytest.mark.slow
def test_gaps_of_a_node_on_a_strip():
    """In front, beside, beyond the end, behind, and out on the other side of a body of half a metre."""
    table = {
        (1.5, 0.5, 0.02): 0.02,
        (0.9, 0.5, -0.4): -0.4,
        (0.9, 0.5, -0.6): 0.6,
        (2.3, 0.5, 0.4): 0.5,
        # Rounding puts what is level with the end of a surface beyond it, where it would go through.
        (2 + 1e-12, 0.5, -0.01): -0.01,
        (2 + 1e-3, 0.5, -0.01): np.hypot(1e-3, 0.01),
        # Far away it crosses the plane of the facets, and nothing happens: the gap has no jump there.
        **{(2.0 + a, 0.5, z): a for a in (0.3, 2.0, 30.0) for z in (1e-6, -1e-6)},
    }
    system, state = above(STRIP, facets=FACETS, open=ENDS, depth=np.array([0.5, 0.5]))
    gaps = gaps_at(system, state, np.array(list(table)))
    np.testing.assert_allclose(gaps, list(table.values()), rtol=1e-9)


def warped_patch(random, warp):
    """Nine facets in a plane but for the warp, each with its corners in turn from any of them on."""
    line = np.linspace(-1.5, 1.5, 4)
    corners = np.array([(x, y, 0.0) for x in line for y in line]) + warp * random.normal(size=(16, 3))
    facets = np.array([(k, k + 4, k + 5, k + 1) for k in (0, 1, 2, 4, 5, 6, 8, 9, 10)])
    facets = np.array([np.roll(facet, random.integers(4)) for facet in facets])
    edges = [frozenset(pair) for facet in facets for pair in zip(facet, np.roll(facet, -1))]
    ends = np.array([edges.count(edge) == 1 for edge in edges], float).reshape(9, 4)
    return corners, {"facets": facets + 1, "open": ends}


@pytest.mark.exhaustive
def test_a_node_far_from_warped_facets():
    """It is as far as their nearest point, in front, beside, or behind all but their ends."""
    line = np.linspace(-1, 1, 9)
    weights = np.array(
        [
            ((1 - u) * (1 - v), (1 + u) * (1 - v), (1 + u) * (1 + v), (1 - u) * (1 + v))
            for u in line
            for v in line
        ]
    )
    for warp in (0.0, 0.01, 0.05):
        random = np.random.default_rng(3)
        corners, facets = warped_patch(random, warp)
        system, state = above(corners, **facets)
        surface = np.einsum("sk,fkx->fsx", weights / 4, corners[facets["facets"] - 1]).reshape(-1, 3)
        direction = random.normal(size=(5000, 3)) * (1.0, 1.0, 0.7)
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        near = random.uniform(-1.5, 1.5, (5000, 3)) * (1, 1, 0)
        at = near + 10.0 ** random.uniform(0, 2, (5000, 1)) * direction
        apart = np.linalg.norm(at[:, None] - surface, axis=2)
        end = 1.5 - np.abs(surface[apart.argmin(axis=1), :2]).max(axis=1) < 0.3
        out = np.linalg.norm(at[:, :2] - np.clip(at[:, :2], -1.5, 1.5), axis=1)
        ahead = at[:, 2] > np.where(out > 0.5, -0.7 * out, 0.5)
        behind = (at[:, 2] < -0.5) & ~end
        assert ahead.sum() > 1000 and behind.sum() > 100
        clear = ahead | behind
        expected = np.where(behind, -1.0, 1.0) * apart.min(axis=1)
        np.testing.assert_allclose(gaps_at(system, state, at)[clear], expected[clear], rtol=0.02)


@pytest.mark.exhaustive
def test_the_gap_beside_a_solid_is_its_distance():
    """Outside, inside, beside its edges and corners, of nodes that know of all its faces."""
    scene = nc.Scene()
    box = scene.add(nc.Solid(nc.mesh.box((1, 1, 1), (2, 2, 1)), material=RUBBER, name="box"))
    placed = {"material": RUBBER, "name": "other", "position": (0, 0, 1.1)}
    other = scene.add(nc.Solid(nc.mesh.box((0.1, 0.1, 0.1), (1, 1, 1)), **placed))
    scene.add(nc.Contact(other.face(), box.face(), one_pass=True, candidates=100, name="gap"))
    system, state = scene.compile()
    first = np.stack([np.asarray(system.sense(state, node).position) for node in other.nodes])
    shifts = np.random.default_rng(6).uniform(-0.3, 1.3, (250, 3)) - (0.05, 0.05, 1.15)
    last = np.any(np.all(np.abs(np.asarray(state.q)[:, None] - first) < 1e-9, axis=-1), axis=1)
    assert last.sum() == len(first)
    q = np.asarray(state.q)[None] + last[:, None] * shifts[:, None]
    gaps = jax.jit(jax.vmap(lambda q: system.sense(nc.State(**{**vars(state), "q": q}), "gap").gap))(q)
    beyond = np.abs(first + shifts[:, None] - 0.5) - 0.5
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    exact = outside + np.minimum(beyond.max(axis=-1), 0.0)
    np.testing.assert_allclose(np.sort(gaps, axis=1), np.sort(exact, axis=1), atol=1e-13)


@pytest.mark.exhaustive
def test_a_body_flies_past_a_surface():
    """Far beside it and across its plane, where a corner that two facets share is nearest: nothing pushes."""
    corners, facets = warped_patch(np.random.default_rng(5), 0.05)
    place, velocity = np.array((-6.0, 0.6, 1.0)), np.array((0.0, 0.0, -2.0))
    system, state = above(corners, place, velocity, **facets)
    trajectory = nc.simulate(system, state, dt=0.01, steps=100)
    straight = place + np.asarray(trajectory.t)[:, None] * velocity
    np.testing.assert_allclose(system.sense(trajectory, "point").position, straight, atol=1e-12)


@pytest.mark.exhaustive
def test_facets_passed_in_one_step():
    """A point slides over a strip of ten facets, one and a half of them a step, and bounces as on a plane."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    point = scene.add(nc.PointMass(mass=1.0, position=(-0.25, 0, 0.02), velocity=(30.0, 0, 0), name="point"))
    corners = [nc.Point(nc.ground, (0.1 * k, y, 0)) for k in range(-5, 12) for y in (-0.5, 0.5)]
    facets = np.array([(1 + 2 * k, 3 + 2 * k, 4 + 2 * k, 2 + 2 * k) for k in range(16)])
    inner = np.ones((16, 4))
    inner[1:, 3] = inner[:-1, 1] = 0.0
    scene.add(nc.NodeOnFacets((nc.Point(point), *corners), facets=facets, open=inner, stiffness=1e5))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=5e-3, steps=7)
    assert_never_gains(system, trajectory)
    assert np.asarray(trajectory.q)[:, 0, 2].min() > -0.02
    np.testing.assert_allclose(np.asarray(trajectory.v)[:, 0, 0], 30.0, rtol=1e-9)


@pytest.mark.exhaustive
def test_a_run_warns_of_a_node_that_leaves_its_facets(recwarn):
    """A cube that slides along a bar, whose nodes know the facets below them only."""
    for sideways in (0.0, 3.0):
        recwarn.clear()
        scene, rubber = nc.Scene(), nc.Elastic(E=1e4, nu=0.3, density=10.0)
        bar = scene.add(nc.Solid(nc.mesh.box((4, 1, 1), (4, 1, 1)), material=rubber, name="bar"))
        scene.add(nc.Clamp(nc.ground, bar.set("z0")))
        cube = nc.mesh.box((0.9, 0.9, 0.9), (1, 1, 1))
        moving = {"position": (0.05, 0.05, 1.01), "velocity": (sideways, 0.0, -2.0)}
        slider = scene.add(nc.Solid(cube, material=rubber, name="slider", **moving))
        options = {"stiffness": 2e3, "candidates": 1, "one_pass": True, "name": "slide"}
        scene.add(nc.Contact(slider.face("z0"), bar.face("z1"), **options))
        system, state = scene.compile()
        nc.simulate(system, state, dt=4e-3, steps=100)
        said = [str(w.message) for w in recwarn if "has left the facets" in str(w.message)]
        assert bool(said) == (sideways > 0)
        assert all("slide" in text and "slider nodes" in text for text in said)


@pytest.mark.exhaustive
def test_mean_gaps_of_shells_and_solids():
    """Between the side of a shell, where its thickness ends, and a solid, and between solids."""
    scene = nc.Scene()
    mesh = nc.mesh.box((1, 1, 1), (1, 1, 1))
    one, two = (scene.add(nc.Solid(mesh, material=RUBBER, position=(0, 0, z))) for z in (0.0, 1.01))
    sheet = {"thickness": 0.01, "material": RUBBER, "position": (0, 0, 3)}
    plate = scene.add(nc.Shell(nc.mesh.rectangle((1, 1), (1, 1)), **sheet))
    scene.add(nc.Contact(plate.surface("inside"), two.face("z1"), method="mortar", name="above"))
    scene.add(nc.Contact(one.face("z1"), two.face("z0"), method="mortar", name="between"))
    system, state = scene.compile()
    np.testing.assert_allclose(system.sense(state, "above").gap, 0.985, rtol=1e-12)
    np.testing.assert_allclose(system.sense(state, "between").gap, 0.01, rtol=1e-12)
