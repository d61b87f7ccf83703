"""Contacts of bodies that drives move: they feel the motion that is prescribed, and drives pay for it."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc

MU, GRAVITY = 0.3, 9.81
LOCATED = nc.EnergyMomentum(max_events=4)
ROUNDED = 1e-11
"""Works of a run, which sum up what Newton's iteration leaves of each step."""


@cache
def belt(speed, **law):
    """A box on a belt that moves at a speed [m/s]."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    track = scene.add(nc.RigidBody(mass=50.0, inertia=(1, 1, 1), velocity=(speed, 0, 0), name="belt"))
    joint = scene.add(nc.Prismatic(nc.ground, track, axis=(1, 0, 0), name="track"))
    scene.add(nc.Drive(joint, function=lambda t: speed * t, name="drive"))
    box = scene.add(nc.PointMass(mass=1.0, name="box"))
    scene.add(nc.Contact(box, nc.Plane(normal=(0, 0, 1), body=track), friction=MU, name="contact", **law))
    return scene.compile()


@pytest.mark.parametrize(
    ("scheme", "law"),
    [
        (nc.EnergyMomentum(), {}),
        pytest.param(nc.EnergyMomentum(kick=True), {}, marks=pytest.mark.exhaustive),
        pytest.param(LOCATED, {}, marks=pytest.mark.exhaustive),
        pytest.param(nc.EnergyMomentum(), {"stiffness": 1e5}, marks=pytest.mark.exhaustive),
    ],
    ids=["hard", "kicks", "located", "soft"],
)
def test_a_belt_takes_a_box_along(scheme, law):
    """Until it does, the belt slips by v^2 / (2 mu g): friction takes half of what the drive gives."""
    speed = 1.0
    system, state = belt(speed, **law)
    run = nc.simulate(system, state, dt=0.01, steps=100, scheme=scheme)
    work = {name: float(value[-1]) for name, value in system.work(run).items()}
    assert abs(work["drive"] - speed**2) <= ROUNDED
    assert abs(work["contact"] + 0.5 * speed**2) <= ROUNDED
    assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE
    taken = speed / (MU * GRAVITY)
    place = float(system.sense(run, "box").position[-1, 0])
    # The step in which slip stops is a whole one.
    assert abs(place - speed * (1.0 - 0.5 * taken)) <= 5e-4
    np.testing.assert_allclose(system.sense(run, "box").velocity[-1, 0], speed, atol=1e-12)


@pytest.mark.parametrize("restitution", [0.5, 0.0], ids=["bounces", "stays"])
@pytest.mark.slow
def test_a_piston_hits_a_ball(restitution):
    """At rest before; then the piston stops, and what stays with it flies on."""
    scene = nc.Scene()
    piston = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), velocity=(1, 0, 0), name="piston"))
    track = scene.add(nc.Prismatic(nc.ground, piston, axis=(1, 0, 0), name="track"))
    scene.add(nc.Drive(track, function=lambda t: jnp.minimum(t, 0.3), name="drive"))
    ball = scene.add(nc.PointMass(mass=1.0, position=(0.1, 0, 0), name="ball"))
    wall = nc.Plane(normal=(1, 0, 0), body=piston)
    scene.add(nc.Contact(ball, wall, restitution=restitution, name="contact"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=0.01, steps=60)
    speed = np.asarray(system.sense(run, "ball").velocity)[:, 0]
    np.testing.assert_allclose(speed[20:], 1.0 + restitution, atol=1e-12)
    assert abs(float(system.energy(run).kinetic[-1]) - 0.5 * (1.0 + restitution) ** 2) <= 1e-12
    assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE


@pytest.mark.exhaustive
@pytest.mark.parametrize("restitution", [0.9, 0.5])
def test_a_soft_piston_hits_a_ball_at_rest(restitution):
    """Damped by the speed at which the piston is driven, not by that which is left to move freely."""
    scene = nc.Scene()
    piston = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), velocity=(1, 0, 0), name="piston"))
    track = scene.add(nc.Prismatic(nc.ground, piston, axis=(1, 0, 0), name="track"))
    scene.add(nc.Drive(track, function=lambda t: 1.0 * t, name="drive"))
    ball = scene.add(nc.PointMass(mass=1.0, position=(0.1, 0, 0), name="ball"))
    law = {"stiffness": 1e4, "restitution": restitution, "speed": 1.0}
    scene.add(nc.Contact(ball, nc.Plane(normal=(1, 0, 0), body=piston), name="contact", **law))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=1e-3, steps=300)
    # (A contact lasts for thirty steps.)
    assert float(system.sense(run, "ball").velocity[-1, 0]) == pytest.approx(1.0 + restitution, abs=1e-3)
    assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE


@pytest.mark.exhaustive
def test_what_slides_on_the_ground_beside_a_belt_does_not_know_of_it():
    """It comes to rest after v^2 / (2 mu g)."""
    scene, speed = nc.Scene(), 1.0
    scene.add(nc.Gravity())
    belt = scene.add(nc.RigidBody(mass=50.0, inertia=(1, 1, 1), velocity=(speed, 0, 0), name="belt"))
    track = scene.add(nc.Prismatic(nc.ground, belt, axis=(1, 0, 0), name="track"))
    scene.add(nc.Drive(track, function=lambda t: speed * t, name="drive"))
    box = scene.add(nc.PointMass(mass=1.0, velocity=(speed, 0, 0), name="box"))
    scene.add(nc.Contact(box, nc.Plane(normal=(0, 0, 1)), friction=MU, name="contact"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=0.01, steps=50)
    moved = system.sense(run, "box")
    np.testing.assert_allclose(moved.velocity[:30, 0], speed - MU * GRAVITY * run.t[:30], atol=1e-12)
    # The step in which slip stops is a whole one.
    assert abs(float(moved.position[-1, 0]) - 0.5 * speed**2 / (MU * GRAVITY)) <= 5e-4
    assert abs(float(system.work(run)["contact"][-1]) + 0.5 * speed**2) <= ROUNDED
    assert abs(float(system.work(run)["drive"][-1])) <= ROUNDED


@pytest.mark.exhaustive
def test_a_shaker_carries_what_its_friction_holds():
    """A sine across the limit of friction: the box moves along below it, and slips above."""
    for amplitude, along in ((0.02, True), (0.2, False)):
        scene = nc.Scene()
        scene.add(nc.Gravity())
        table = scene.add(nc.RigidBody(mass=5.0, inertia=(1, 1, 1), name="table"))
        track = scene.add(nc.Prismatic(nc.ground, table, axis=(1, 0, 0), name="track"))
        scene.add(nc.Drive(track, function=lambda t, a=amplitude: a * (1.0 - jnp.cos(8.0 * t)), name="drive"))
        box = scene.add(nc.PointMass(mass=1.0, name="box"))
        scene.add(nc.Contact(box, nc.Plane(normal=(0, 0, 1), body=table), friction=MU, name="contact"))
        system, state = scene.compile()
        run = nc.simulate(system, state, dt=2e-3, steps=500)
        apart = np.asarray(system.sense(run, "box").position - system.sense(run, "table").position)[:, 0]
        acceleration = amplitude * 64.0
        assert along == (acceleration < MU * GRAVITY)
        assert (np.max(np.abs(apart)) <= 1e-5) == along, amplitude
        assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE


@pytest.mark.exhaustive
def test_a_gripper_lifts_a_box_by_a_drive():
    """Two fingers hold a box by friction, and a drive lifts them."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    palm = scene.add(nc.RigidBody(mass=1.0, inertia=(0.01,) * 3, position=(0, 0, 0.3), name="palm"))
    lift = scene.add(nc.Prismatic(nc.ground, palm, axis=(0, 0, 1), name="lift"))
    size = (0.06, 0.04, 0.04)
    box = scene.add(nc.RigidBody(shape=nc.Box(size), density=0.3 / float(np.prod(size)), name="box"))
    for k, y in enumerate((1, -1)):
        finger = nc.RigidBody(mass=0.1, inertia=(1e-4,) * 3, position=(0, 0.02 * y, 0), name=f"finger {k}")
        finger = scene.add(finger)
        joint = scene.add(nc.Prismatic(palm, finger, axis=(0, -y, 0), name=f"slide {k}"))
        scene.add(nc.JointForce(joint, name=f"squeeze {k}"))
        inside = nc.Plane(normal=(0, -y, 0), point=(0, 0.02 * y, 0), body=finger)
        scene.add(nc.Contact(box, inside, friction=0.6, name=f"pad {k}"))
    scene.add(nc.Drive(lift, function=lambda t: 0.25 * t**2, name="drive"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=5e-3, steps=160, inputs=np.array([20.0, 20.0]))
    height = float(system.sense(run, "box").position[-1, 2])
    assert abs(height - 0.25 * 0.8**2) <= 2e-6
    assert float(np.max(nc.balance(system, run).energy)) <= tol.STEP_BALANCE


# --- what friction and drives do, by closed forms ---------------------------------------------------------

RADIUS, SPEED, DENSITY = 0.1, 1.0, 500.0
ALONG_Y = ((1, 0, 0), np.pi / 2)
RIDERS = {
    "ball": (nc.Sphere(RADIUS), {}),
    "capsule": (nc.Capsule(RADIUS, 0.3), {"orientation": ALONG_Y}),
    "cylinder": (nc.Cylinder(RADIUS, 0.3), {"orientation": ALONG_Y}),
    "box": (nc.Box((0.6, 0.4, 2 * RADIUS)), {}),
}
CREEP = 1e-5
"""Part of the work of friction that is done by what rolls, and creeps."""


def account(system, run):
    """Works at all times, those of the gaps of a contact summed up."""
    works = {}
    for name, work in system.work(run).items():
        works[name.split("[")[0]] = works.get(name.split("[")[0], 0.0) + np.asarray(work)
    assert float(np.max(nc.balance(system, run).energy)) <= 2e-13
    return works


def carried(rider, belt="plane", *, geared=False):
    """What lies on a belt that runs, which is a plane or a box, or one that a shaft drives by a gear."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    start = {"velocity": (SPEED, 0, 0), "name": "belt"}
    if belt == "box":
        part = nc.RigidBody(shape=nc.Box((4.0, 1.0, 0.2)), density=50.0, position=(0, 0, -0.1), **start)
    else:
        part = nc.RigidBody(mass=50.0, inertia=(1, 1, 1), **start)
    track = scene.add(part)
    joint = scene.add(nc.Prismatic(nc.ground, track, axis=(1, 0, 0), name="track"))
    turns = 2.0 if geared else 1.0
    if geared:
        shaft = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), angular_velocity=(0, 0, 2 * SPEED)))
        slide, joint = joint, scene.add(nc.Revolute(nc.ground, shaft, axis=(0, 0, 1), name="shaft"))
        scene.add(nc.Coupling((joint, slide), factors=(1.0, -turns), name="gear"))
    scene.add(nc.Drive(joint, function=lambda t: turns * SPEED * t, name="drive"))
    shape, turned = RIDERS[rider]
    body = nc.RigidBody(shape=shape, density=DENSITY, position=(0, 0, RADIUS), name="rider", **turned)
    body = scene.add(body)
    side = nc.Plane(body=track) if belt == "plane" else track
    scene.add(nc.Contact(body, side, restitution=0.0, friction=MU, name="rubs"))
    mass, inertia = (np.asarray(x) for x in shape.mass_properties(DENSITY))
    rolls = rider != "box"
    axis = 2 if turned else 1
    return *scene.compile(), SPEED / (1.0 / mass + rolls * RADIUS**2 / inertia[axis, axis]), mass


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("rider", "how"),
    [
        ("ball", {}),
        ("capsule", {}),
        ("cylinder", {}),
        ("box", {}),
        ("ball", {"belt": "box"}),
        ("ball", {"geared": True}),
    ],
    ids=["ball", "capsule", "cylinder", "box", "on a box", "geared"],
)
def test_what_a_belt_takes_along_rolls_or_rests(rider, how):
    """Friction takes half of what the drive gives: the impulse times the speed of the belt."""
    system, state, impulse, mass = carried(rider, **how)
    run = nc.simulate(system, state, dt=0.01, steps=40)
    work = account(system, run)
    # (What turns has an energy across its axis that its drive pays for, of the order of the step squared.)
    near = CREEP * 2.0 if how.get("geared") else 0.0
    assert abs(work["drive"][-1] - impulse * SPEED) <= ROUNDED + near
    assert abs(work["rubs"][-1] + 0.5 * impulse * SPEED) <= CREEP * impulse * SPEED
    velocity = np.asarray(system.sense(run, "rider").velocity)[-1]
    np.testing.assert_allclose(velocity, (impulse / mass, 0.0, 0.0), atol=1e-11)


def rubbed(work, pressed, slip):
    """That friction's work in every step is mu N times the slip."""
    np.testing.assert_allclose(np.diff(work), -MU * pressed * np.abs(slip), rtol=1e-9, atol=1e-12)


def mean_spin(rate, h):
    """Of a step that turns a body by rate times h, by Cayley's formula."""
    return 2.0 / h * np.tan(0.5 * rate * h)


@pytest.mark.exhaustive
def test_a_turntable_rubs_a_mass_that_slips_outwards():
    rate, h, mass = 4.0, 0.01, 1.5
    scene = nc.Scene()
    scene.add(nc.Gravity())
    table = scene.add(nc.RigidBody(mass=5.0, inertia=(1, 1, 1), angular_velocity=(0, 0, rate), name="table"))
    shaft = scene.add(nc.Revolute(nc.ground, table, axis=(0, 0, 1), name="shaft"))
    scene.add(nc.Drive(shaft, function=lambda t: rate * t, name="drive"))
    body = scene.add(nc.PointMass(mass=mass, position=(0.5, 0, 0), name="mass"))
    scene.add(nc.Contact(body, nc.Plane(body=table), friction=MU, name="rubs"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=h, steps=60)
    work, place = account(system, run), np.asarray(system.sense(run, "mass").position)
    middle, speed = 0.5 * (place[1:] + place[:-1]), np.diff(place, axis=0) / h
    slip = speed - mean_spin(rate, h) * np.cross((0, 0, 1), middle)
    rubbed(work["rubs"], mass * GRAVITY, h * np.linalg.norm(slip, axis=1))
    assert np.linalg.norm(place[-1]) > 0.6


@pytest.mark.exhaustive
def test_a_tilting_table_holds_a_mass_as_long_as_friction_does():
    """Until g sin(a) - w^2 r = mu g cos(a); then it slides down."""
    rate, h, radius = 0.5, 0.01, 0.4
    scene = nc.Scene()
    scene.add(nc.Gravity())
    table = scene.add(nc.RigidBody(mass=5.0, inertia=(1, 1, 1), angular_velocity=(0, -rate, 0), name="table"))
    hinge = scene.add(nc.Revolute(nc.ground, table, axis=(0, -1, 0), name="hinge"))
    scene.add(nc.Drive(hinge, function=lambda t: rate * t, name="drive"))
    start = {"position": (radius, 0, 0), "velocity": (0, 0, rate * radius)}
    body = scene.add(nc.PointMass(mass=1.0, name="mass", **start))
    scene.add(nc.Contact(body, nc.Plane(body=table), restitution=0.0, friction=MU, name="rubs"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=h, steps=80)
    work, t = account(system, run), np.asarray(run.t)
    place = np.asarray(system.sense(run, "mass").position)
    angle = rate * t
    along = place[:, 0] * np.cos(angle) + place[:, 2] * np.sin(angle)
    above = place[:, 2] * np.cos(angle) - place[:, 0] * np.sin(angle)
    assert np.abs(above).max() <= 1e-12
    holds = GRAVITY * np.sin(angle) - rate**2 * radius <= MU * GRAVITY * np.cos(angle)
    last = np.flatnonzero(holds)[-1]
    assert np.abs(along - radius)[: last - 1].max() <= 1e-5
    assert along[last + 10] <= radius - 1e-4
    # At rest on the table, the drive lifts it.
    lifted = np.sin(angle[last - 1]) * radius * GRAVITY
    assert abs(work["drive"][last - 1] - lifted) <= 1e-4
    assert abs(work["rubs"][last - 1]) <= 1e-4


@pytest.mark.exhaustive
def test_a_cam_lifts_a_follower():
    """An eccentric ball below a flat plate: it goes up and down as a sine, and rubs."""
    rate, eccentric, radius, mass, h = 8.0, 0.05, 0.2, 2.0, 5e-3
    scene = nc.Scene()
    scene.add(nc.Gravity())
    cam = nc.RigidBody(
        shape=nc.Sphere(radius),
        density=DENSITY,
        position=(eccentric, 0, 0),
        velocity=(0, 0, -rate * eccentric),
        angular_velocity=(0, rate, 0),
        name="cam",
    )
    cam = scene.add(cam)
    shaft = scene.add(nc.Revolute(nc.ground, cam, axis=(0, 1, 0), point=(0, 0, 0), name="shaft"))
    scene.add(nc.Drive(shaft, function=lambda t: rate * t, name="drive"))
    start = {"position": (0, 0, radius), "velocity": (0, 0, -rate * eccentric)}
    plate = scene.add(nc.RigidBody(mass=mass, inertia=(1, 1, 1), name="plate", **start))
    scene.add(nc.Prismatic(nc.ground, plate, axis=(0, 0, 1), name="guide"))
    below = nc.Plane(normal=(0, 0, -1), point=(0, 0, radius), body=plate)
    scene.add(nc.Contact(cam, below, friction=MU, name="rubs"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=h, steps=200)
    work, t = account(system, run), np.asarray(run.t)
    height = np.asarray(system.sense(run, "plate").position)[:, 2]
    np.testing.assert_allclose(height, radius - eccentric * np.sin(rate * t), atol=1e-12)
    lifting = np.asarray(run.v)[:, 4 * system.body_index("plate"), 2]
    pressed = mass * (np.diff(lifting) / h + GRAVITY)
    slip = np.diff(eccentric * np.cos(rate * t)) + h * radius * mean_spin(rate, h)
    rubbed(work["rubs"], pressed, slip)


@pytest.mark.exhaustive
def test_a_shaker_in_two_directions_rubs():
    """Up and down by less than gravity, and to and fro by more than friction."""
    mass, h = 1.5, 5e-3
    scene = nc.Scene()
    scene.add(nc.Gravity())
    slides, base = [], nc.ground
    for name, axis in (("base", (1, 0, 0)), ("table", (0, 0, 1))):
        part = scene.add(nc.RigidBody(mass=5.0, inertia=(1, 1, 1), name=name))
        slides.append(scene.add(nc.Prismatic(base, part, axis=axis, name=f"slide of {name}")))
        base = part
    scene.add(nc.Drive(slides[0], function=lambda t: 0.2 * (1.0 - jnp.cos(8.0 * t)), name="along"))
    scene.add(nc.Drive(slides[1], function=lambda t: 0.02 * (1.0 - jnp.cos(20.0 * t)), name="up"))
    body = scene.add(nc.PointMass(mass=mass, name="mass"))
    scene.add(nc.Contact(body, nc.Plane(body=base), friction=MU, name="rubs"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=h, steps=200)
    work, t = account(system, run), np.asarray(run.t)
    place = np.asarray(system.sense(run, "mass").position)
    np.testing.assert_allclose(place[:, 2], 0.02 * (1.0 - np.cos(20.0 * t)), atol=1e-12)
    lifting = np.asarray(run.v)[:, 4 * system.body_index("mass"), 2]
    pressed = mass * (np.diff(lifting) / h + GRAVITY)
    slip = np.diff(place[:, 0] - 0.2 * (1.0 - np.cos(8.0 * t)))
    slides_on = np.flatnonzero((slip[1:] * slip[:-1] > 0) & (np.abs(slip[1:]) > 1e-3 * h))
    rubs = np.diff(work["rubs"])[1:]
    assert len(slides_on) > 100
    expected = -MU * pressed[1:] * np.abs(slip[1:])
    np.testing.assert_allclose(rubs[slides_on], expected[slides_on], rtol=1e-7)


@pytest.mark.exhaustive
def test_a_driven_roller_pushes_a_cart():
    """Its weight presses it on: the cart goes as fast as its rim in the end, with half of its work."""
    rate, mass = 5.0, 3.0
    speed = rate * RADIUS
    scene = nc.Scene()
    scene.add(nc.Gravity())
    cart = scene.add(nc.RigidBody(mass=mass, inertia=(1, 1, 1), name="cart"))
    scene.add(nc.Prismatic(nc.ground, cart, axis=(1, 0, 0), name="rail"))
    slide = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), position=(0, 0, 0.5), name="slide"))
    scene.add(nc.Prismatic(nc.ground, slide, axis=(0, 0, 1), name="guide"))
    roller = {"shape": nc.Sphere(RADIUS), "density": DENSITY, "position": (0, 0, RADIUS)}
    roller = scene.add(nc.RigidBody(**roller, angular_velocity=(0, rate, 0), name="roller"))
    shaft = scene.add(nc.Revolute(slide, roller, axis=(0, 1, 0), point=(0, 0, RADIUS), name="shaft"))
    scene.add(nc.Drive(shaft, function=lambda t: rate * t, name="drive"))
    scene.add(nc.Contact(roller, nc.Plane(body=cart), restitution=0.0, friction=MU, name="rubs"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=0.01, steps=40)
    work = account(system, run)
    # (A step that turns by 0.05 has the slip of its tangent.)
    assert work["drive"][-1] == pytest.approx(mass * speed**2, rel=3e-4)
    assert work["rubs"][-1] == pytest.approx(-0.5 * mass * speed**2, rel=1e-3)
    assert float(system.sense(run, "cart").velocity[-1, 0]) == pytest.approx(-speed, rel=3e-4)


@pytest.mark.exhaustive
def test_a_gripper_that_turns_holds_a_box():
    """About an axis that is off the box: its friction carries weight, whichever way that pulls."""
    rate, size = 2.0, (0.06, 0.04, 0.04)
    scene = nc.Scene()
    scene.add(nc.Gravity())

    def turning(place):
        return {"velocity": tuple(np.cross((0, rate, 0), np.subtract(place, (0, 0, 0.3)))),
                "position": place, "angular_velocity": (0, rate, 0)}  # fmt: skip

    palm = scene.add(nc.RigidBody(mass=1.0, inertia=(0.01,) * 3, name="palm", **turning((0, 0, 0.3))))
    wrist = scene.add(nc.Revolute(nc.ground, palm, axis=(0, 1, 0), point=(0, 0, 0.3), name="wrist"))
    box = nc.RigidBody(
        shape=nc.Box(size), density=0.3 / float(np.prod(size)), name="box", **turning((0, 0, 0))
    )
    box = scene.add(box)
    for k, y in enumerate((1, -1)):
        finger = nc.RigidBody(mass=0.1, inertia=(1e-4,) * 3, name=f"finger {k}", **turning((0, 0.02 * y, 0)))
        finger = scene.add(finger)
        joint = scene.add(nc.Prismatic(palm, finger, axis=(0, -y, 0), name=f"slide {k}"))
        scene.add(nc.JointForce(joint, name=f"squeeze {k}"))
        inside = nc.Plane(normal=(0, -y, 0), point=(0, 0.02 * y, 0), body=finger)
        scene.add(nc.Contact(box, inside, restitution=0.0, friction=0.6, name=f"pad {k}"))
    scene.add(nc.Drive(wrist, function=lambda t: rate * t, name="drive"))
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=5e-3, steps=160, inputs=np.array([20.0, 20.0]))
    work, angle = account(system, run), rate * np.asarray(run.t)
    place = np.asarray(system.sense(run, "box").position)
    arm = np.stack([-0.3 * np.sin(angle), 0.0 * angle, 0.3 - 0.3 * np.cos(angle)], axis=1)
    assert np.abs(place - arm).max() <= 2e-5
    # The drive lifts palm, fingers and box.
    lifted = (0.3 + 2 * 0.1) * GRAVITY * arm[:, 2]
    assert np.abs(work["drive"] - lifted).max() <= 1e-3


@pytest.mark.exhaustive
def test_readings_and_transfers_obey_what_is_driven():
    """Velocities that are read of a belt and what it has taken along, and a state that is handed on."""
    system, state = belt(1.0)
    run = nc.simulate(system, state, dt=0.01, steps=100)
    rows = np.asarray(system.tangent(run).v)[:, :, 0]
    index = [4 * system.body_index(name) for name in ("belt", "box")]
    assert np.abs(rows[:, index[0]] - 1.0).max() <= 1e-12
    assert np.abs(rows[50:, index[1]] - 1.0).max() <= 1e-12
    assert np.abs(np.asarray(system.rate(run, "track")) - 1.0).max() <= 1e-12
    faster, after = nc.transfer(system, state, belt(2.0)[0])
    assert float(faster.rate(after, "track")) == pytest.approx(2.0, abs=1e-12)
