"""Contact of all pairs of some bodies: as written by hand, what is left out, wrong input."""

from itertools import combinations

import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc

WALLS = [nc.Plane(normal=n, point=-0.3 * np.array(n)) for n in np.concatenate([np.eye(3), -np.eye(3)])]
SHAPES = nc.Sphere(0.06), nc.Capsule(0.04, 0.1), nc.Box((0.1, 0.08, 0.06))
SOFT = {"stiffness": 1e4}


def bodies(scene, count, shapes=SHAPES[:1], inwards=0.0):
    """On a lattice, each with a velocity of its own or to the middle, in turn of these shapes."""
    drift = np.array((0.3, 0.1, 0.0))
    random, lattice = np.random.default_rng(7), np.array([-0.15, 0.15])
    places = [(x, y, z) for x in lattice for y in lattice for z in lattice][:count]
    return [
        scene.add(
            nc.RigidBody(
                shape=shapes[k % len(shapes)],
                density=500.0,
                position=place,
                velocity=drift + random.normal(size=3) * (inwards == 0) - inwards * np.array(place),
                name=f"body {k}",
            )
        )
        for k, place in enumerate(places)
    ]


def in_a_box(contacts, count=6, **given):
    """Bodies between six walls; how they go on after a while."""
    scene = nc.Scene()
    found = bodies(scene, count)
    for body in found:
        for wall in WALLS:
            scene.add(nc.Contact(body, wall, **given))
    contacts(scene, found)
    system, state = scene.compile()
    return system, nc.simulate(system, state, dt=2e-3, steps=250)


def test_all_pairs_are_those_by_hand():
    """Spheres in a box, that meet each other and the walls: the same motion to rounding, energy kept."""

    def by_hand(scene, found):
        for one, other in combinations(found, 2):
            scene.add(nc.Contact(one, other, **SOFT))

    found = []
    for way in (by_hand, lambda scene, found: scene.add(nc.Contact(all_pairs_of=found, name="all", **SOFT))):
        system, trajectory = in_a_box(way, **SOFT)
        assert nc.balance(system, trajectory).energy.max() <= 10 * tol.ENERGY_OF_A_SMALL_SCENE
        found.append(np.asarray(trajectory.q))
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)
    _, alone = in_a_box(lambda scene, found: None, **SOFT)
    assert np.abs(np.asarray(alone.q) - found[0]).max() > 0.1
    force = np.asarray(nc.contacts(system, trajectory).force)
    names = nc.contacts(system, trajectory).names
    met = {name for name, most in zip(names, force.max(axis=0)) if most > 0 and name.startswith("all[")}
    assert met and met <= {f"all[{a}, {b}]" for a, b in combinations([f"body {k}" for k in range(6)], 2)}


@pytest.mark.exhaustive
def test_mixed_shapes_keep_what_they_should():
    """Spheres, capsules and boxes in space that fly at each other: momenta and energy."""
    scene = nc.Scene()
    found = bodies(scene, 8, SHAPES, inwards=5.0)
    scene.add(nc.Contact(all_pairs_of=found, rounding=0.02, stiffness=5e4))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-3, steps=180)
    assert nc.balance(system, trajectory).energy.max() <= 10 * tol.ENERGY_OF_A_SMALL_SCENE
    for momentum in (system.momentum(trajectory), system.angular_momentum(trajectory)):
        assert np.ptp(np.asarray(momentum), axis=0).max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert (nc.contacts(system, trajectory).force.max(axis=0) > 0).sum() >= 2


def test_what_is_left_out():
    """Pairs that are to be ignored, in either order, and those with a joint between them."""
    scene = nc.Scene()
    a, b, c, d = bodies(scene, 4)
    scene.add(nc.Spherical(b, c))
    made = scene.add(nc.Contact(all_pairs_of=[a, b, c, d], ignore=[(d, a), (a, b)], name="all"))
    assert [handle.name for handle in made] == [
        f"all[body {i}, body {j}]" for i, j in ((0, 2), (1, 3), (2, 3))
    ]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda a, b, c: nc.Contact(all_pairs_of=[a]), "all_pairs_of has 1 bodies, 1 of them different"),
        (lambda a, b, c: nc.Contact(all_pairs_of=[a, a]), "2 bodies, 1 of them different; pass two"),
        (lambda a, b, c: nc.Contact(all_pairs_of=[a, b], ignore=[(a, c)]), "ignore names 'body 2'"),
        (lambda a, b, c: nc.Contact(all_pairs_of=[a, b], ignore=[(b, a)]), "are ignored or have a joint"),
        (lambda a, b, c: nc.Contact(a, b, all_pairs_of=[a, c]), "is instead of two sides"),
        (lambda a, b, c: nc.Contact(a), "is of what with what"),
        (lambda a, b, c: nc.Contact(all_pairs_of=[a, "b"]), "all_pairs_of"),
    ],
)
def test_wrong_input_is_refused(make, message):
    scene = nc.Scene()
    given = bodies(scene, 3)
    with pytest.raises(ValueError, match=message):
        scene.add(make(*given))


def test_too_many_pairs_are_refused():
    scene = nc.Scene()
    many = [scene.add(nc.PointMass(mass=1.0, position=(k, 0, 0))) for k in range(2)]
    many += [scene.add(nc.RigidBody(shape=SHAPES[0], density=1.0, position=(k, 1, 0))) for k in range(64)]
    with pytest.raises(ValueError, match="all pairs of 64 bodies have more than 2000 gaps"):
        scene.add(nc.Contact(all_pairs_of=many[2:]))
    with pytest.raises(ValueError, match="are points, which do not overlap"):
        scene.add(nc.Contact(all_pairs_of=many[:2]))


@pytest.mark.parametrize(
    ("law", "words"),
    [
        ({}, "looked for instead: pass `stiffness` .N/m.$"),
        ({"stiffness": 1e4, "friction": 0.3}, "looked for instead: leave out `friction` .-.$"),
        ({"friction": 0.3}, "looked for instead: pass `stiffness` .N/m., leave out `friction` .-.$"),
    ],
)
def test_what_has_no_search_is_told(law, words):
    """What to change of a hundred capsules, so that only near ones are looked at."""
    scene, link = nc.Scene(), {"shape": nc.Capsule(0.1, 0.2), "density": 1.0}
    links = [scene.add(nc.RigidBody(**link, position=(k, 1, 0))) for k in range(100)]
    with pytest.raises(ValueError, match=words):
        scene.add(nc.Contact(all_pairs_of=links, **law))
    box = scene.add(nc.RigidBody(shape=nc.Box((1, 1, 1)), density=1.0, name="crate"))
    with pytest.raises(ValueError, match="make Box 'crate' of spheres and capsules"):
        scene.add(nc.Contact(all_pairs_of=[*links, box], **law))


@pytest.mark.parametrize("option", [{"candidates": 4}, {"one_pass": True}])
def test_options_of_surfaces_are_refused_where_none_touch(option):
    scene = nc.Scene()
    found = bodies(scene, 2)
    with pytest.raises(ValueError, match="is an option of two surfaces; leave it out"):
        scene.add(nc.Contact(all_pairs_of=found, **option))
