"""Wrong contacts, and what contacts do not do: each refused by name, with what to do; nothing is compiled."""

import re

import pytest
from contact_scenes import BALL, FLOOR, RUBBER, SECTION

import natcoord_jax as nc

BOX, CAPSULE = nc.Box((1, 1, 1)), nc.Capsule(0.1, 0.2)


def parts():
    """A scene with some of everything, far apart; `at` finds them by name."""
    scene = nc.Scene()
    shapes = {
        "ball": nc.Sphere(0.1),
        "other ball": nc.Sphere(0.1),
        "third ball": nc.Sphere(0.1),
        "box": BOX,
        "flat": nc.Box((1, 1, 0.1)),
        "other flat": nc.Box((1, 1, 0.1)),
        "pebble": nc.Ellipsoid((1, 1, 1)),
        "can": nc.Cylinder(0.1, 0.2),
    }
    at = {
        name: scene.add(nc.RigidBody(shape=shape, density=1.0, position=(10 * k, 0, 0), name=name))
        for k, (name, shape) in enumerate(shapes.items())
    }
    at["bare"] = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), name="bare"))
    for k in range(2):
        at[f"point {k}"] = scene.add(nc.PointMass(mass=1.0, position=(k, 50, 0), name=f"point {k}"))
    mesh = nc.mesh.box((1, 1, 1), (1, 1, 1))
    for k, z in enumerate((0.0, 1.01)):
        block = nc.Solid(mesh, material=RUBBER, position=(0, 100, z), name=f"block {k}")
        at[f"block {k}"] = scene.add(block)
    plate = {"thickness": 0.01, "material": RUBBER, "position": (0, 100, 3), "name": "plate"}
    at["plate"] = scene.add(nc.Shell(nc.mesh.rectangle((1, 1), (1, 1)), **plate))
    at["cable"] = scene.add(nc.Beam(SECTION, [(0, -100, 0), (0, -100, 1)], elements=10, name="cable"))
    at["short"] = scene.add(nc.Beam(SECTION, [(1, -100, 0), (1, -100, 0.1)], elements=2, name="short"))
    return scene, at


def pairs_of(*names, **options):
    """A contact of all pairs."""
    return lambda at: nc.Contact(all_pairs_of=[at.get(name, name) for name in names], **options)


def of(one, other, **options):
    """A contact of two of the parts, or of what is passed."""
    return lambda at: nc.Contact(
        *(at[side] if isinstance(side, str) and side in at else side for side in (one, other)), **options
    )


def faces(one, other, **options):
    """A contact of faces of solids."""
    return lambda at: nc.Contact(
        *(at[name].face(face) for name, face in (one, other)), **{"name": "c", **options}
    )


UPPER, LOWER = ("block 0", "z1"), ("block 1", "z0")
MIXED = ("ball", "other ball", "third ball")
HARD = "capacity and skin .* of spheres, capsules and points with a stiffness"
SEVERAL = "is an option of two surfaces; leave it out"
WRONG = [
    # Shapes and sides.
    (of("bare", FLOOR, stiffness=1.0), "'bare' has no shape; give it one"),
    (of("ball", "floor", stiffness=1.0), "other is 'floor'"),
    (of(FLOOR, FLOOR), "'ground' would be in contact with itself"),
    (of("box", "pebble", stiffness=1.0), "no gap between Box 'box' and Ellipsoid 'pebble'"),
    (of("box", "can", stiffness=1.0), "no gap between Box 'box' and Cylinder 'can'"),
    (of("can", FLOOR, stiffness=1.0), "stiffness .* of Cylinder 'can' would be"),
    (of("flat", "other flat", rounding=0.05), r"rounding \[m\] is 0.05, but .* as short as 0.1 m"),
    (of("ball", "box", rounding=0.01), "rounding is an option of the edges of two boxes; leave"),
    (of("cable", "cable", stiffness=1e3), "'cable' would be in contact with itself.*self_contact"),
    (of("cable", "short", stiffness=1e3, self_contact=True), "self_contact=True is for a beam with itself"),
    (of("short", "short", stiffness=1e3, self_contact=True), "'short' is too short to touch itself"),
    # Numbers.
    (of("ball", FLOOR, stiffness=0.0), "stiffness.*positive"),
    (of("ball", FLOOR, stiffness=1.0, restitution=1.2, speed=1.0), "up to 1"),
    (of("ball", FLOOR, stiffness=1.0, restitution=0.5), "is that of one speed"),
    (of("ball", FLOOR, restitution=2.0), "^contact 'contact 1': restitution"),
    (of("ball", FLOOR, restitution=1.5), "restitution .* 1.5; .* not negative and up to 1"),
    (of("ball", FLOOR, restitution=0.5, speed=1.0), "speed .* of contacts with a stiffness"),
    (of("block 0", "block 1", stiffness=-1.0), "stiffness.*positive"),
    # Surfaces.
    (faces(UPPER, ("block 0", "z0")), "'block 0' would be in contact with itself"),
    (of("block 0", "ball", friction=0.3), "no friction .* but those of solids on planes; leave it out"),
    (of("plate", FLOOR, friction=0.3), "no friction .* but those of solids on planes; leave it out"),
    (faces(UPPER, LOWER, friction=0.3, method="mortar"), "a mortar has no friction .*method='nodes'"),
    (faces(UPPER, LOWER, method="mortar", one_pass=True), "mortar has one pass.*leave out one_pass"),
    (of("block 0", nc.Plane(point=(0, 0, -1)), method="mortar"), "method is an option of two surfaces"),
    (
        lambda at: nc.Contact(at["plate"], at["block 1"].face("z1"), method="mortar"),
        "one side of 'plate'.*surface",
    ),
    # All pairs.
    (pairs_of("ball"), "all_pairs_of has 1 bodies, 1 of them different"),
    (pairs_of("ball", "ball"), "2 bodies, 1 of them different; pass two"),
    (
        lambda at: nc.Contact(
            all_pairs_of=[at["ball"], at["box"]], ignore=[(at["ball"], at["can"])]
        ),
        "ignore names 'can'",
    ),
    (
        lambda at: nc.Contact(
            all_pairs_of=[at["ball"], at["box"]], ignore=[(at["box"], at["ball"])]
        ),
        "are ignored or have a joint",
    ),
    (
        lambda at: nc.Contact(at["ball"], at["box"], all_pairs_of=[at["ball"], at["can"]]),
        "is instead of two sides",
    ),
    (lambda at: nc.Contact(at["ball"]), "is of what with what"),
    (pairs_of("ball", "somebody"), "all_pairs_of"),
    (pairs_of("point 0", "point 1"), "are points, which do not overlap"),
    (pairs_of("ball", "other ball", candidates=4), SEVERAL),
    (pairs_of("ball", "other ball", one_pass=True), SEVERAL),
    # A search.
    (pairs_of(*MIXED, capacity=4), HARD),
    (pairs_of(*MIXED, stiffness=1.0, skin=0.1, friction=0.3), HARD),
    (pairs_of(*MIXED, stiffness=1.0, capacity=3, one_pass=True), "one_pass is no option of spheres"),
    (pairs_of(*MIXED, stiffness=1.0, capacity=0), "capacity"),
    (pairs_of(*MIXED, stiffness=1.0, skin=-0.1), "skin"),
    (
        lambda at: nc.CapsuleContacts(
            (nc.Point(at["point 0"]), nc.Point(at["point 1"])), radii=(0.1,), stiffness=1.0
        ),
        "first ends of all segments and then",
    ),
    (
        lambda at: nc.CapsuleContacts((nc.Point(at["ball"]),) * 3, radii=(0.1, 0.1), stiffness=1.0),
        "3 markers and 2 radii",
    ),
]  # fmt: skip


def complaint(make, message):
    """What is wrong with how a wrong input is refused, or nothing."""
    try:
        make()
    except (ValueError, nc.SimulationError) as error:
        return None if re.search(message, str(error), re.S) else f"{message!r} is not in {error}"
    return f"nothing says {message!r}"


def test_wrong_contacts_are_refused():
    scene, at = parts()
    wrong = [complaint(lambda make=make: scene.add(make(at)), message) for make, message in WRONG]
    assert not [text for text in wrong if text], "\n".join(text for text in wrong if text)


def test_too_many_pairs_are_refused():
    """Of what has no search is told what to change, so that only near ones are looked at."""
    scene, link = nc.Scene(), {"shape": CAPSULE, "density": 1.0}
    links = [scene.add(nc.RigidBody(**link, position=(k, 1, 0))) for k in range(66)]
    box = scene.add(nc.RigidBody(shape=BOX, density=1.0, name="crate"))
    end = "looked for instead: "
    wrong = [
        complaint(lambda bodies=bodies, law=law: scene.add(nc.Contact(all_pairs_of=bodies, **law)), message)
        for bodies, law, message in (
            (links, {}, "all pairs of 66 bodies have more than 2000 gaps"),
            (links, {}, end + "pass `stiffness` .N/m.$"),
            (links, {"stiffness": 1e4, "friction": 0.3}, end + "leave out `friction` .-.$"),
            (links, {"friction": 0.3}, end + "pass `stiffness` .N/m., leave out `friction` .-.$"),
            ([*links, box], {}, "make Box 'crate' of spheres and capsules"),
        )
    ]
    assert not any(wrong), wrong


def dropped(height=1.0, **contact):
    """A ball above a floor."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, height + 0.1), name="ball"))
    scene.add(nc.Contact(ball, FLOOR, name="bounce", **contact))
    return scene.compile()


SOFT = {"stiffness": 2e4, "restitution": 0.5, "speed": 1.0}
SET = [
    (SOFT, {"restitution": 1.2}, "contact 'bounce'.*restitution"),
    (SOFT, {"restitution": 0.0}, "contact 'bounce'.*restitution"),
    (SOFT, {"stiffness": 0.0}, "contact 'bounce'.*stiffness"),
    ({"restitution": 0.5}, {"restitution": 1.5}, "'bounce': restitution is 1.5; .* up to 1"),
    ({**SOFT, "friction": 0.3}, {"restitution": 1.5}, "'bounce': restitution is 1.5"),
]
ORDER_FOUR = nc.EnergyMomentum(order=4)
LOCATED = nc.EnergyMomentum(max_events=4)
HARD_ONLY = "hard contact 'bounce'.*EnergyMomentum"
STEPS = [
    ({}, {"scheme": ORDER_FOUR}, HARD_ONLY),
    ({}, {"scheme": nc.VariationalMidpoint()}, HARD_ONLY),
    ({}, {"scheme": nc.Dissipative()}, HARD_ONLY),
    (
        {**SOFT, "friction": 0.3},
        {"scheme": ORDER_FOUR},
        "soft contact with friction 'bounce'.*EnergyMomentum",
    ),
    ({}, {"scheme": LOCATED, "rtol": 1e-6}, "rtol and atol make substeps .* leave out one of the two"),
    (SOFT, {"scheme": LOCATED}, "max_events .* has no such contact; leave it out"),
]


def test_what_contacts_do_not_do_is_refused():
    """Numbers that would give energy, schemes without impacts, equilibria, vibrations and accelerations."""
    wrong = [
        complaint(lambda law=law, numbers=numbers: dropped(**law)[0].set("bounce", **numbers), message)
        for law, numbers, message in SET
    ]
    for law, options, message in STEPS:
        system, state = dropped(**law)
        wrong.append(
            complaint(
                lambda system=system, state=state, options=options: nc.simulate(
                    system, state, dt=0.01, steps=2, **options
                ),
                message,
            )
        )
    wrong.append(
        complaint(lambda: nc.EnergyMomentum(order=4, max_events=4), "impacts are located at order 2: leave")
    )
    wrong.append(complaint(lambda: dropped(-0.05), "hard contact 'bounce' overlap by 0.05 m"))
    hard, start = dropped(0.0)
    statics = ((nc.equilibrium, {}), (nc.modes, {}), (nc.load_path, {"arc": 0.1, "steps": 3}))
    for ask, options in statics:
        wrong.append(
            complaint(
                lambda ask=ask, options=options: ask(hard, start, **options),
                "hard contact 'bounce'.*stiffness",
            )
        )
    closed = "closed contacts of a system with hard contact 'bounce'"
    wrong.append(complaint(lambda: hard.instant(start), closed))
    rough, lying = dropped(**SOFT, friction=0.3)
    wrong.append(
        complaint(lambda: nc.equilibrium(rough, lying), "'bounce' is not defined.*leave out the friction")
    )
    lower = nc.State(**{**vars(start), "q": start.q.at[0, 2].add(-0.02)})
    wrong.append(complaint(lambda: nc.simulate(hard, lower, dt=0.01, steps=5), "'bounce' overlap by 0.02 m"))
    assert not [text for text in wrong if text], "\n".join(text for text in wrong if text)


def test_surfaces_that_overlap_from_the_start_are_refused():
    scene = nc.Scene()
    mesh = nc.mesh.box((1, 1, 1), (1, 1, 1))
    one, two = (scene.add(nc.Solid(mesh, material=RUBBER, position=p)) for p in ((0, 0, 0), (0.3, 0.2, 0.9)))
    scene.add(nc.Contact(one.face("z1"), two.face("z0")))
    with pytest.raises(ValueError, match="starts in penetration"):
        scene.compile()


class PointAboveGround(nc.Gap):
    """A gap that does not say where surfaces touch."""

    def invariants(self, x):
        return (x[1] @ (x[2] - x[0]))[None]

    def distance(self, invariants):
        return invariants[0]


def test_friction_needs_a_point_of_contact():
    above = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1)), nc.Point(nc.ground, (0, 0, 1))
    nc.GapConstraint(above, PointAboveGround())
    with pytest.raises(ValueError, match="PointAboveGround does not say.*contact"):
        nc.GapConstraint(above, PointAboveGround(), friction=0.3)
