"""Numbers of parts by name, another time to start at, and reactions about a point."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc


def scene(stiffness=50.0, mass=1.0, inertia=(1.0, 1.0, 2.0), gravity=-9.81, com=(0.1, 0.0, 0.2)):
    """A round body and a point mass on equal springs, and a hinged arm with a stop."""
    made = nc.Scene()
    made.add(nc.Gravity(vector=(0.0, 0.0, gravity), name="gravity"))
    body = nc.RigidBody(mass=mass, inertia=inertia, com=com, name="body", angular_velocity=(0.3, 1.0, 2.0))
    ends = made.add(body), made.add(nc.PointMass(mass=2.0, position=(1.0, 0.0, 0.0), name="bead"))
    for k, end in enumerate(ends):
        points = nc.Point(nc.ground, (0.0, 0.0, 1.0)), nc.Point(end, (1.0, 0.0, 0.0))
        made.add(nc.Spring(points, stiffness=stiffness, name=f"spring {k}"))
    arm = made.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), com=(0.5, 0.0, 0.0), name="arm"))
    hinge = made.add(nc.Revolute(nc.ground, arm, axis=(0, 1, 0), name="hinge"))
    made.add(nc.JointStops(hinge, stiffness=100.0, lower=-1.0, name="stops"))
    return made.compile()


@pytest.fixture(scope="module")
def compiled():
    return scene()


def end(system, state):
    return nc.simulate(system, state, dt=0.05, steps=20).q[-1]


def test_every_number_has_a_name(compiled):
    """What there is of a body, a point mass, an effect, a joint."""
    system, _ = compiled
    numbers = system.get("body")
    assert list(numbers) == ["mass_block", "mass", "com", "inertia"]
    assert np.allclose(numbers["inertia"], np.diag([1.0, 1.0, 2.0])) and np.allclose(
        numbers["com"], [0.1, 0, 0.2]
    )
    assert list(system.get("bead")) == ["mass_block", "mass"]
    assert system.get("spring 1", "stiffness") == 50.0
    assert system.get(("spring 0", "spring 1"), "stiffness").shape == (2,)
    assert system.get("gravity", "vector").shape == (3,)
    assert system.get("stops", "lower") == -1.0 and system.get("stops", "upper") == np.inf
    assert system.get("hinge", "frames").shape == (2, 4, 4)


def test_set_is_as_built_anew(compiled):
    """Leaf by leaf, but for what was found of symmetry; the motion, from the same program."""
    system, state = compiled
    changed = (
        system.set(["spring 0", "spring 1"], stiffness=60.0)
        .set("body", mass=3.0, inertia=(1.0, 1.5, 2.0), com=(0.0, 0.1, 0.0))
        .set("gravity", vector=(0.0, 0.0, -1.0))
    )
    anew, _ = scene(60.0, 3.0, (1.0, 1.5, 2.0), -1.0, (0.0, 0.1, 0.0))
    assert jax.tree.structure(changed) == jax.tree.structure(system)
    assert np.allclose(changed.mass, anew.mass, atol=1e-15)
    assert np.abs(end(changed, state) - end(anew, state)).max() < 1e-11
    assert np.all(system.get("spring 0", "stiffness") == 50.0), "the system itself was changed"
    each = system.set(["spring 0", "spring 1"], stiffness=(1.0, 2.0))
    assert np.array_equal(each.get(["spring 0", "spring 1"], "stiffness"), [1.0, 2.0])


@pytest.mark.slow
def test_set_compiles_nothing_and_is_differentiable(compiled, programs):
    """A gradient by a number of one part of a stack, against differences; no rollout is compiled."""
    system, state = compiled

    def height(stiffness, mass):
        changed = system.set("spring 0", stiffness=stiffness).set("body", mass=mass)
        return end(changed, state)[0, 2]

    height(50.0, 1.0)
    del programs[:]
    pairs = ((50.001, 1.0), (49.999, 1.0)), ((50.0, 1.00001), (50.0, 0.99999))
    heights = [[float(height(*numbers)) for numbers in pair] for pair in pairs]
    assert "jit(_compiled)" not in programs
    expected = [(a - b) / h for (a, b), h in zip(heights, (2e-3, 2e-5), strict=True)]
    assert jax.grad(height, argnums=(0, 1))(50.0, 1.0) == pytest.approx(expected, rel=1e-6)


def test_what_is_wrong_is_named(compiled):
    system, _ = compiled
    springs = ["spring 0", "spring 1"]
    wrong = [
        (
            lambda s: s.set("nothing", x=1.0),
            "no part 'nothing'; it has the bodies .*'arm'.*'hinge'.*'gravity'",
        ),
        (lambda s: s.set("spring 0", rest=1.0), r"has no number 'rest'; it has \['stiffness', 'length'"),
        (
            lambda s: s.set("spring 0", stiffness=(1.0, 2.0)),
            r"spring 'spring 0': stiffness \[N/m\] has shape \(2,\); pass shape \(\)",
        ),
        (lambda s: s.set("body", inertia=(1.0, 2.0)), r"body 'body': inertia \[kg m\^2\] has shape \(2,\)"),
        (lambda s: s.set(springs, stiffness=(1, 2, 3)), r"pass shape \(\) or \(2,\)"),
        (lambda s: s.set("bead", inertia=(1.0, 1.0, 1.0)), "'bead' has no number 'inertia'"),
        (lambda s: s.set("body", mass=-1.0), r"'body': mass \[kg\] is -1.0; pass a positive"),
        (lambda s: s.set("spring 0", stiffness=-1.0), "spring 0"),
        (lambda s: s.set("body", mass=1.0, mass_block=np.eye(4)), "not both"),
        (lambda s: s.set("spring 0", stiffness=np.nan), "pass finite"),
        (lambda s: s.set("spring 0"), "nothing to set"),
        (lambda s: s.get("spring 0", "rest"), "has no number 'rest'"),
    ]
    for change, message in wrong:
        with pytest.raises(ValueError, match=message):
            change(system)


REFUSED = {
    ("spring 0", "stiffness"): -1.0,
    ("body", "mass"): 0.0,
    ("contact", "friction"): -0.3,
    ("contact", "restitution"): 1.5,
    ("soft", "restitution"): 1.5,
}


def landing(shape):
    """A body that slides where it lands, on a spring."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    start = {"position": (0, 0, 0.3), "velocity": (1, 0, 0)}
    body = scene.add(nc.RigidBody(shape=shape, density=100.0, **start, name="body"))
    ends = nc.Point(nc.ground, (0, 0, 2.0)), nc.Point(body)
    scene.add(nc.Spring(ends, stiffness=0.5, length=1.0, name="spring 0"))
    scene.add(nc.Contact(nc.Plane(normal=(0, 0, 1)), body, restitution=0.5, friction=0.3, name="contact"))
    soft = {"stiffness": 1e3, "restitution": 0.5, "speed": 1.0, "name": "soft"}
    ball = scene.add(nc.PointMass(mass=1.0, position=(5, 0, 0.2)))
    scene.add(nc.Contact(ball, nc.Plane(normal=(0, 0, 1)), **soft))
    return scene.compile()


@pytest.mark.exhaustive
def test_what_would_be_refused_ends_a_run_inside_of_jit():
    """A number that is refused where it is known is not a number where it is traced, of its own lane only."""
    system, state = landing(nc.Sphere(0.1))
    for (part, field), bad in REFUSED.items():
        with pytest.raises(ValueError, match=part):
            system.set(part, **{field: bad})

    def run(values):
        changed = system
        for (part, field), value in zip(REFUSED, values):
            changed = changed.set(part, **{field: value})
        return nc.simulate(changed, state, dt=0.01, steps=40)

    good, bad = np.full(5, 0.5), np.array(list(REFUSED.values()))
    runs = jax.jit(jax.vmap(run))(np.where(np.eye(6, 5, dtype=bool), bad, good))
    failed, well = int(nc.Result.NONFINITE), int(nc.Result.SUCCESSFUL)
    assert list(np.asarray(runs.result)) == [failed] * 5 + [well]


def test_a_name_that_parts_share_is_all_of_them():
    """The gaps of a contact, which a user never named."""
    system, _ = landing(nc.Box((0.2, 0.2, 0.2)))
    changed = system.set("contact", friction=0.4, restitution=0.1)
    assert np.array_equal(changed.get("contact", "friction"), [0.4] * 8)
    assert float(changed.get("contact[3]", "restitution")) == 0.1
    each = system.set("contact", friction=np.linspace(0.1, 0.8, 8))
    assert float(each.get("contact[7]", "friction")) == 0.8
    with pytest.raises(ValueError, match="no part 'contac'"):
        system.set("contac", friction=0.4)


@pytest.mark.slow
def test_starting_at_another_time():
    """A load and a drive that depend on time: a run in two parts, and one that starts in between."""

    def build(t):
        made = nc.Scene()
        body = made.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="body"))
        disc = made.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), position=(3, 0, 0), name="disc"))
        hinge = made.add(nc.Revolute(nc.ground, disc, name="hinge"))
        made.add(nc.PointForce((nc.Point(body),), force=lambda t: jnp.array([t, 0.0, 0.0])))
        made.add(nc.Drive(hinge, function=lambda t: (t - 2.0) ** 2))
        return made.compile(t=t)

    system, state = build(2.0)
    assert float(state.t) == 2.0
    late = nc.simulate(system, state, dt=0.1, steps=10)
    assert late.t[0] == 2.0 and late.t[-1] == pytest.approx(3.0)
    # The impulse of a force t from 2 to 3 s is 2.5 N s, and the mid-point rule is exact for it.
    assert system.momentum(late)[-1, 0] == pytest.approx(2.5, abs=1e-12)
    assert system.sense(late, "hinge").angle[-1] == pytest.approx(1.0, abs=1e-12)
    moved = state.at_time(3.0)
    assert float(moved.t) == 3.0 and moved.q is state.q
    with pytest.raises(ValueError, match="state: t"):
        state.at_time(jnp.zeros(2))


@pytest.mark.slow
def test_reactions_about_a_point():
    """Statics of an arm on an upright hinge: its moment about any point is that of the weight about it."""
    made = nc.Scene()
    made.add(nc.Gravity(vector=(0.0, 0.0, -10.0)))
    beam = made.add(
        nc.RigidBody(mass=2.0, inertia=(1.0, 1.0, 1.0), com=(0.7, 0.2, 0.0), position=(1, 0, 0), name="beam")
    )
    hinge = made.add(nc.Revolute(nc.ground, beam, point=(0.5, 0.0, 0.3), name="hinge"))
    system, state = made.compile()
    weight, centre = np.array([0.0, 0.0, -20.0]), np.array([1.7, 0.2, 0.0])

    def needed(point):
        return -np.cross(centre - np.asarray(point), weight)

    assert np.allclose(system.sense(state, hinge).torque, needed((0.5, 0.0, 0.3)), atol=1e-12)
    for point in ((0.0, 0.0, 0.0), (3.0, -1.0, 2.0)):
        assert np.allclose(system.sense(state, hinge, about=point).torque, needed(point), atol=1e-12)
    tip = nc.Point(beam, (1.0, 0.0, 0.0), local=True)
    assert np.allclose(system.sense(state, hinge, about=tip).torque, needed((2.0, 0.0, 0.0)), atol=1e-12)
    traced = jax.jit(lambda system, state: system.sense(state, hinge, about=tip).torque)
    assert np.allclose(traced(system, state), needed((2.0, 0.0, 0.0)), atol=1e-12)
    ground = nc.Point(nc.ground, (0.0, 0.0, 1.0))
    assert np.allclose(system.sense(state, hinge, about=ground).torque, needed((0, 0, 1)), atol=1e-12)
    run = nc.simulate(system, state, dt=0.1, steps=2)
    along = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    torques = system.sense(run, hinge, about=along).torque
    assert np.allclose(torques, [needed(x) for x in along], atol=1e-9)
    assert np.allclose(system.sense(run, hinge, about=tip).torque[-1], needed((2.0, 0.0, 0.0)), atol=1e-9)
    for part, about, message in (
        (beam, (0, 0, 0), "no reaction"),
        (hinge, (0.0, 0.0), "about .* has shape"),
        (hinge, nc.Direction(beam, (1, 0, 0)), "direction"),
    ):
        with pytest.raises(ValueError, match=message):
            system.sense(state, part, about=about)


# --- numbers that no part can have ------------------------------------------------------------------------

GOOD = {
    "mass": 1.0, "inertia": (1.0, 1.1, 1.2), "orientation": np.eye(3), "axis": (0.0, 1.0, 0.0),
    "stiffness": 1.0, "length": 0.2, "armature": 0.1, "lower": -1.0, "limit": 2.0, "restitution": 0.5,
    "bounce": 0.0, "friction": 0.3, "radius": 0.1, "normal": (0.0, 0.0, 1.0), "wall": 0.005, "nu": 0.3,
    "section": np.diag([1e4, 1e4, 1e5, 10.0, 10.0, 8.0]), "poisson": 0.3, "second": (0.1, 0.1, 0.1),
}  # fmt: skip
SKEW = np.diag([1e4, 1e4, 1e5, 10.0, 10.0, 8.0])
SKEW[3, 4] = 5.0
IMPOSSIBLE = [
    ("mass", -1.0), ("mass", np.inf), ("inertia", (1.0, 1.0, 5.0)), ("inertia", (-1.0, 1.0, 1.0)),
    ("second", (0.1, -0.1, 0.1)), ("orientation", 2.0 * np.eye(3)),
    ("orientation", np.diag([1.0, 1.0, -1.0])), ("axis", (0.0, 0.0, 0.0)),
    ("stiffness", -1.0), ("stiffness", np.nan), ("length", -1.0),
    ("armature", -1.0), ("lower", 3.0), ("lower", np.nan), ("limit", -3.0), ("restitution", 1.5),
    ("restitution", 0.0), ("bounce", 1.1), ("friction", -1.0), ("radius", -0.1), ("normal", (0.0, 0.0, 0.0)),
    ("wall", 0.015), ("nu", 0.9), ("section", SKEW), ("section", -np.abs(SKEW)), ("poisson", 0.5),
]  # fmt: skip


def workshop(n):
    """A scene of many parts by their numbers, and something of all of them."""
    made = nc.Scene()
    body = nc.RigidBody(mass=n["mass"], inertia=n["inertia"], orientation=n["orientation"], name="arm")
    arm = made.add(body)
    hinge = made.add(nc.Revolute(nc.ground, arm, axis=n["axis"], name="hinge"))
    made.add(nc.JointSpring(hinge, stiffness=n["stiffness"]))
    made.add(nc.Armature(hinge, inertia=n["armature"]))
    made.add(nc.JointStops(hinge, stiffness=1.0, lower=n["lower"], upper=2.0))
    made.add(nc.AffineActuator((hinge,), lower=-2.0, upper=n["limit"]))
    ends = nc.Point(nc.ground, (0.0, 0.0, 1.0)), nc.Point(arm)
    made.add(nc.Spring(ends, stiffness=1.0, length=n["length"]))
    ball = made.add(nc.RigidBody(mass=1.0, second_moment=n["second"], position=(5, 0, 1), name="ball"))
    floor = nc.Point(nc.ground), nc.Direction(nc.ground, n["normal"]), nc.Point(ball)
    soft = {"stiffness": 10.0, "restitution": n["restitution"], "speed": 1.0}
    made.add(nc.GapPotential(floor, nc.SphereOnPlane(radius=n["radius"]), **soft))
    hard = {"friction": n["friction"], "restitution": n["bounce"]}
    made.add(nc.GapConstraint(floor, nc.SphereOnPlane(), **hard))
    rod = {"radius": 0.01, "E": 1e9, "density": 1e3}
    tube = nc.TubularSection(thickness=n["wall"], nu=n["nu"], **rod)
    plate = nc.Elastic(E=1.0, nu=n["poisson"])
    data = nc.Section(n["section"], np.diag([1.0, 1e-4, 1e-4]))
    alone = tube.stiffness[5, 5] + data.stiffness[0, 0] + plate.plane_stress()[0, 0]
    system, state = made.compile()
    return system, state, alone


def test_impossible_numbers_are_refused_and_traced_none_of_their_lane():
    """A body or a law with them would gain energy: outside of jit an error, inside not a number."""
    for name, bad in IMPOSSIBLE:
        with pytest.raises(ValueError, match=r"\[|has|belongs"):
            workshop({**GOOD, name: bad})

    def momentum(n):
        system, state, alone = workshop(n)
        return system.momentum(state)[0] + 0.0 * alone

    rows = [GOOD, *({**GOOD, name: bad} for name, bad in IMPOSSIBLE)]
    lanes = {name: np.stack([np.asarray(row[name], float) for row in rows]) for name in GOOD}
    found = np.asarray(jax.jit(jax.vmap(momentum))(lanes))
    assert np.isfinite(found[0])
    passed = [case for case, x in zip(IMPOSSIBLE, found[1:], strict=True) if not np.isnan(x)]
    assert not passed, passed


@pytest.mark.exhaustive
def test_directions_without_length_and_sizes_below_zero_that_are_traced_are_none():
    """Outside of jit they are refused by the table of bodies, of parts and of sections."""

    def turned(orientation):
        made = nc.Scene()
        made.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), orientation=orientation))
        return jnp.sum(made.compile()[1].q)

    def rubbing(friction):
        made = nc.Scene()
        ball = made.add(nc.RigidBody(shape=nc.Sphere(0.1), density=1.0, position=(0, 0, 0.05)))
        made.add(nc.Contact(ball, nc.Plane(), stiffness=1e3, friction=friction))
        system, state = made.compile()
        return system.energy(state).total

    def all_of_them(x):
        section = nc.CircularSection(radius=x - 0.1, E=1e9, density=1e3)
        return jnp.stack(
            [
                turned((jnp.stack([x, x, x]), 1.0)),
                turned(jnp.stack([x, x, x, x])),
                section.stiffness[2, 2],
                rubbing(x - 0.1),
            ]
        )

    good, bad = np.asarray(jax.jit(jax.vmap(all_of_them))(jnp.array([0.5, 0.0])))
    assert np.isfinite(good).all() and np.isnan(bad).all(), bad


@pytest.mark.slow
def test_a_number_that_is_none_ends_the_run():
    """A comparison with it would leave a stop, or a contact, out of the motion."""
    made = nc.Scene()
    made.add(nc.Gravity())
    ball = made.add(nc.RigidBody(shape=nc.Sphere(0.1), density=100.0, position=(0, 0, 0.2)))
    made.add(nc.Contact(ball, nc.Plane(), stiffness=1e4, name="floor"))
    slider = made.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), position=(1, 0, 0)))
    slide = made.add(nc.Prismatic(nc.ground, slider, axis=(0, 0, -1.0)))
    made.add(nc.JointStops(slide, upper=0.05, stiffness=1e4, name="stops"))
    system, state = made.compile()

    def run(radius, upper, stiffness):
        changed = system.set("floor", **{"gap.radius": radius})
        changed = changed.set("stops", upper=upper, stiffness=stiffness)
        return nc.simulate(changed, state, dt=0.01, steps=30).result

    good, bad = [0.1, 0.05, 1e4], [(0, np.nan), (1, np.nan), (2, np.nan), (0, -1.0), (0, np.inf)]
    rows = np.array([good, *([bad_x if k == j else x for j, x in enumerate(good)] for k, bad_x in bad)])
    results = jax.jit(jax.vmap(run))(*rows.T)
    assert list(np.asarray(results)) == [int(nc.Result.SUCCESSFUL)] + [int(nc.Result.NONFINITE)] * len(bad)


def test_what_only_the_assembled_pose_takes_cannot_be_set(compiled):
    """The zero of a hinge counts in the state; the pitch of a screw is one of the system, traced too."""
    with pytest.raises(ValueError, match="hinge' has no number 'zero'.*in the scene, and compile"):
        compiled[0].set("hinge", zero=0.3)
    made = nc.Scene()
    nut = made.add(nc.RigidBody(mass=1.0, inertia=(0.01, 0.01, 0.01)))
    made.add(nc.Screw(nc.ground, nut, axis=(0, 0, 1), pitch=0.2, name="screw"))
    system, _ = made.compile()

    def factor(pitch):
        return system.set("screw", pitch=pitch).get("screw pitch", "factors")[0]

    value, slope = jax.jit(jax.value_and_grad(factor))(0.4)
    assert np.allclose([value, slope, factor(0.4)], np.array([-0.4, -1.0, -0.4]) / (2 * np.pi), atol=1e-15)


@pytest.mark.exhaustive
def test_a_nut_falls_by_the_pitch_that_was_set():
    """As it does where it was built so: a = -m g / (m + I (2 pi / p)^2)."""

    def made(pitch):
        scene = nc.Scene()
        scene.add(nc.Gravity())
        nut = scene.add(nc.RigidBody(mass=1.0, inertia=(0.01, 0.01, 0.01)))
        scene.add(nc.Screw(nc.ground, nut, axis=(0, 0, 1), pitch=pitch, name="screw"))
        return scene.compile()

    (system, state), built = made(0.2), made(0.4)
    changed = system.set("screw", pitch=0.4)
    cases = {"built": (0.2, system, state), "other": (0.4, *built), "set": (0.4, changed, state)}
    ends = {}
    for name, (pitch, of, start) in cases.items():
        ends[name] = np.asarray(nc.simulate(of, start, dt=0.005, steps=100).q[-1])
        exact = -0.5 * 9.81 * 0.5**2 / (1.0 + 0.01 * (2.0 * np.pi / pitch) ** 2)
        # (The angle of the last step is 0.1; motions differ by a twelfth of its square.)
        assert ends[name][0, 2] == pytest.approx(exact, rel=1e-3), name
    assert np.allclose(ends["other"], ends["set"], rtol=0, atol=1e-12)


@pytest.mark.exhaustive
def test_a_scene_of_impossible_numbers_that_are_traced_ends_its_run():
    """Built inside of jit, lane by lane: the others go on."""

    def run(mass, stiffness, inertia):
        made = nc.Scene()
        made.add(nc.Gravity(vector=(0.0, -1.0, 0.0)))
        moments = jnp.stack([inertia, inertia, inertia])
        body = made.add(nc.RigidBody(mass=mass, inertia=moments, com=(0.5, 0.0, 0.0)))
        made.add(nc.JointSpring(made.add(nc.Revolute(nc.ground, body)), stiffness=stiffness))
        return nc.simulate(*made.compile(), dt=0.01, steps=40).result

    rows = np.array([(1.0, 1.0, 0.1), (1.0, -20.0, 0.1), (-1.0, 1.0, 0.1), (1.0, 1.0, -0.5)])
    results = jax.jit(jax.vmap(run))(*rows.T)
    assert list(np.asarray(results)) == [int(nc.Result.SUCCESSFUL)] + [int(nc.Result.NONFINITE)] * 3


def test_inertias_that_no_body_has_cannot_be_set(compiled):
    """Nor text, nor what is not finite; of three bodies a matrix for all, or rows of principal ones."""
    system, _ = compiled
    skewed = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    wrong = [
        ({"inertia": (1.0, 1.0, 5.0)}, "belongs to no body"),
        ({"inertia": (-1.0, 1.0, 1.0)}, "belongs to no body"),
        ({"inertia": skewed}, "not symmetric"),
        ({"mass_block": np.triu(np.ones((4, 4)))}, "not symmetric"),
        ({"mass_block": -np.eye(4)}, r"mass \[kg\] is -1"),
        ({"mass_block": np.diag([1.0, 1.0, 1.0, -3.0])}, "belongs to no body"),
        ({"mass": "1"}, "is '1'; pass numbers"),
        ({"mass": np.inf}, "not finite"),
    ]
    for values, message in wrong:
        with pytest.raises(ValueError, match=message):
            system.set("body", **values)
    same = system.set("body", mass_block=system.get("body", "mass_block"))
    assert np.array_equal(same.mass, system.mass)
    made, names = nc.Scene(), ["a", "b", "c"]
    for name in names:
        made.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name=name))
    trio, _ = made.compile()
    rows = np.array([(1.0, 1.1, 1.2), (2.0, 2.1, 2.2), (3.0, 3.1, 3.2)])
    tensor = np.array([(2.0, 0.3, 0.1), (0.3, 2.5, 0.2), (0.1, 0.2, 3.0)])
    wanted = [(rows, np.array([np.diag(row) for row in rows])), (tensor, np.stack([tensor] * 3))]
    traced = jax.jit(lambda x: trio.set(names, inertia=x).get(names, "inertia"))
    for value, expected in wanted:
        assert np.allclose(trio.set(names, inertia=value).get(names, "inertia"), expected, atol=1e-14)
        assert np.allclose(traced(value), expected, atol=1e-14)
