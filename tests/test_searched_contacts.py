"""What is told of pairs that are looked for: the numbers of listed ones, of those that come near."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax.viz import motion

RADIUS = 0.1
LAWS = {
    "spheres": {"restitution": 0.6, "speed": 3.0, "law": "hertz"},
    "capsules": {},
}
APART = {"spheres": 0.22, "capsules": 0.33}


def heap(kind, searched):
    """Six bodies on a lattice, with velocities at random, and two points that are in no contact.

    The first two hang on each other by a joint, the second and third are ignored.
    """
    random, scene = np.random.default_rng(3), nc.Scene()
    lattice = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:6]
    places = APART[kind] * lattice + 0.01 * random.normal(size=(6, 3))
    velocities = 2.0 * random.normal(size=(6, 3))
    velocities[1] = velocities[0]
    bodies = []
    for k, (x, v) in enumerate(zip(places, velocities)):
        ball = kind == "spheres" or k % 3 == 2
        shape = nc.Sphere(RADIUS) if ball else nc.Capsule(RADIUS, 0.2)
        given = {"shape": shape, "density": 900.0, "position": x, "velocity": v, "name": f"body {k}"}
        bodies.append(scene.add(nc.RigidBody(**given)))
    for k in range(2):
        given = {"position": (0.1, 0.1, 0.6 + 0.01 * k), "velocity": (0, 0, -3.0), "name": f"point {k}"}
        bodies.append(scene.add(nc.PointMass(mass=1.0, **given)))
    scene.add(nc.Spherical(*bodies[:2], point=0.5 * (places[0] + places[1])))
    ignored = [tuple(bodies[1:3])] + ([] if searched else [tuple(bodies[6:])])
    given = {"stiffness": 2e5, "ignore": ignored, "capacity": 8 if searched else None, **LAWS[kind]}
    scene.add(nc.Contact(all_pairs_of=bodies, name="all", **given))
    return scene.compile()


FIELDS = "gap", "force", "active", "impacts", "inside", "margin"


@pytest.mark.parametrize("kind", LAWS)
def test_numbers_are_those_of_listed_pairs(kind):
    """Of two lanes, of one alone, and of the notes; what is left out stays farther apart than the skin.

    Could go wrong: pairs that are joined or ignored, and points, which are near each other here.
    """
    (system, state), (listing, _) = (heap(kind, searched) for searched in (True, False))

    def run(factor):
        start = eqx.tree_at(lambda s: s.v, state, factor * state.v)
        return nc.simulate(system, start, dt=1e-3, steps=100)

    trajectory = jax.vmap(run)(jnp.array([1.0, 0.3]))
    found, listed = nc.contacts(system, trajectory), nc.contacts(listing, trajectory)
    at = [listed.names.index(name) for name in found.names]
    assert len(at) > 3 and found.force.max() > 1.0 and not found.hard.any()
    for field in FIELDS:
        some, every = getattr(found, field), getattr(listed, field)
        np.testing.assert_allclose(some, every[..., at], rtol=1e-10, atol=1e-10, err_msg=field)
    np.testing.assert_array_equal(found.steps_in_contact, listed.steps_in_contact[at])
    assert found.notes == listed.notes and (np.isfinite(found.steps_in_contact).sum() > 1)
    left = np.delete(listed.gap, at, axis=-1)
    assert left.shape[-1] > 3 and left.min() >= 0.25 * RADIUS

    alone = nc.contacts(system, jax.tree.map(lambda x: x[0], trajectory))
    at = [found.names.index(name) for name in alone.names]
    for field in FIELDS:
        np.testing.assert_allclose(getattr(alone, field), getattr(found, field)[0][..., at], atol=1e-12)


def row(gaps, floor=False, **contact):
    """Balls in a row at rest with gaps between them, for three steps."""
    scene, ball, x = nc.Scene(), {"shape": nc.Sphere(RADIUS), "density": 900.0}, 0.0
    balls = []
    for k, gap in enumerate((0.0, *gaps)):
        x += gap + 2 * RADIUS * (k > 0)
        balls.append(scene.add(nc.RigidBody(**ball, position=(x, 0, RADIUS), name=f"ball {k}")))
        if floor:
            scene.add(nc.Contact(balls[-1], nc.Plane(), restitution=0.0, name=f"floor of ball {k}"))
    if floor:
        scene.add(nc.Gravity())
    scene.add(nc.Contact(all_pairs_of=balls, stiffness=1e5, name="all", **contact))
    system, state = scene.compile()
    return system, nc.simulate(system, state, dt=1e-4, steps=3)


def test_what_is_far_is_not_told():
    """Nothing at all, where no pair has come within the skin; a wider skin tells of more."""
    found = nc.contacts(*row((0.03, 0.06), capacity=4))
    assert found.names == () and found.notes == () and found.gap.shape == (4, 0)
    assert found.steps_in_contact.shape == (0,) and repr(found) == (
        "no bodies have come within the skin of their contact"
    )
    found = nc.contacts(*row((0.03, 0.06), skin=0.05))
    assert found.names == ("all[ball 0, ball 1]",)
    np.testing.assert_allclose(found.margin, 0.03, atol=1e-12)
    assert repr(found) == "least margin 0.03 m of 1 contacts"


def test_a_lane_that_has_failed_brings_nothing_near():
    """Could go wrong: the gap of places that are no numbers is one of no distance."""
    system, trajectory = row((-0.01, 0.5), capacity=4)
    lost = eqx.tree_at(lambda t: t.states.q, trajectory, jnp.nan * trajectory.states.q)
    both = jax.tree.map(lambda *x: jnp.stack(x), trajectory, lost)
    found, alone = nc.contacts(system, both), nc.contacts(system, trajectory)
    assert found.names == alone.names == ("all[ball 0, ball 1]",)
    np.testing.assert_array_equal(found.force[0], alone.force)
    assert alone.force.min() > 100.0


def test_capsules_of_one_body_are_told_by_their_numbers():
    """And what is on the ground by that."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, position=(0, 0, 0.21), name="ball"))
    centres = nc.Point(nc.ground), nc.Point(nc.ground, (0.05, 0, 0)), nc.Point(ball, (0, 0, 0.21))
    given = {"radii": np.full(3, RADIUS), "ignored": [(0, 1)], "stiffness": 1e5}
    scene.add(nc.CapsuleContacts(centres, **given, name="all"))
    system, state = scene.compile()
    found = nc.contacts(system, nc.simulate(system, state, dt=1e-3, steps=2))
    assert found.names == ("all[ground (0), ball]", "all[ground (1), ball]")
    np.testing.assert_allclose(found.gap[0], [0.01, np.hypot(0.05, 0.21) - 0.2], atol=1e-12)


def arrows(system, trajectory):
    """Arrows of a run by name."""
    shown = motion.scenery_at(nc.Phases((system,), (trajectory,)), np.asarray(trajectory.t))
    return [(s.name, s.rows) for s in shown.solids if s.kind == "force"]


def test_arrows_are_those_of_listed_pairs(monkeypatch):
    """Balls on a floor that push each other apart: from where each two touch, along the row."""
    (system, trajectory), listed = (row((-0.01, -0.02), True, **x) for x in ({"capacity": 4}, {}))
    found, wanted = dict(arrows(system, trajectory)), dict(arrows(*listed))
    floor, pairs = {f"floor of ball {k}" for k in range(3)}, ("all[ball 0, ball 1]", "all[ball 1, ball 2]")
    assert set(found) == set(wanted) == {*floor, *pairs}
    for name, rows in wanted.items():  # (Their tips and where they begin; they are round.)
        np.testing.assert_allclose(found[name][:, [0, 3]], rows[:, [0, 3]], atol=1e-9)
    np.testing.assert_allclose(found[pairs[1]][0, 0], [0.19 + 0.09, 0, 0.1], atol=1e-6)
    assert np.all(found[pairs[1]][:, 3, 0] > 0)
    told = nc.contacts(system, trajectory)
    assert told.names == (*sorted(floor), *pairs) and told.hard.tolist() == [True] * 3 + [False] * 2
    monkeypatch.setattr("natcoord_jax.viz.arrows.STRONGEST", 1)
    assert {name for name, _ in arrows(system, trajectory)} == {*floor, pairs[1]}


def test_nothing_near_has_no_arrow():
    """Could go wrong: the largest of no forces."""
    assert arrows(*row((0.03,), capacity=4)) == []


def test_the_sensor_that_there_is_not():
    """Refused by name, with what tells of pairs."""
    system, trajectory = row((0.03,), capacity=4)
    with pytest.raises(ValueError, match=r"'all' has no sensor.*`nc.contacts\(system, trajectory\)`"):
        system.sense(trajectory, "all")
