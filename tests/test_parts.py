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
        (lambda s: s.set("spring 0", stiffness=(1.0, 2.0)), r"stiffness has shape \(2,\); pass shape \(\)"),
        (lambda s: s.set(springs, stiffness=(1, 2, 3)), r"pass shape \(\) or \(2,\)"),
        (lambda s: s.set("bead", inertia=(1.0, 1.0, 1.0)), "'bead' has no number 'inertia'"),
        (lambda s: s.set("body", mass=-1.0), r"'body': mass \[kg\] is -1; pass positive"),
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
