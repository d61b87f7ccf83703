"""What lies, stands and comes to rest on contacts: nothing moves by more than rounding, nothing turns."""

import equinox as eqx
import jax
import numpy as np
import pytest
import tolerances as tol
from contact_scenes import BALL, FLOOR, assert_never_gains

import natcoord_jax as nc

G = 9.81


@pytest.mark.slow
def test_a_ball_at_rest_is_untouched():
    """At gap zero, for a thousand steps, whatever falls beside it; and what falls comes to rest exactly."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    still = scene.add(nc.RigidBody(**BALL, position=(0, 0, 0.1), name="still"))
    # At the origin there is neither a speed nor a place that rounding could be compared with.
    stone = scene.add(nc.PointMass(mass=0.1, position=(0, 0, 0.2)))
    scene.add(nc.Contact(still, FLOOR, restitution=0.7))
    scene.add(nc.Contact(stone, FLOOR, restitution=0.0))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.01, steps=1000)
    at = system.sense(trajectory, still)
    assert np.abs(np.asarray(at.velocity)).max() <= 1e-15
    assert np.abs(np.asarray(at.position) - (0, 0, 0.1)).max() <= 1e-15
    assert np.abs(np.asarray(system.sense(trajectory, stone).position)[30:]).max() <= 1e-15
    assert int(trajectory.steps_rejected) <= 4


def box(size, *, dt, steps=1000, restitution, friction, **start):
    """A box on the floor, all whose numbers share one program: the system, its motion, readings, handle."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    made = scene.add(nc.RigidBody(shape=nc.Box(size), density=500.0, name="box", **start))
    scene.add(nc.Contact(made, FLOOR, restitution=restitution, friction=friction, name="floor"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=dt, steps=nc.Steps(steps, 1000))
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    energy = np.asarray(system.energy(trajectory).total)
    assert np.diff(energy).max() <= 1e-12 * energy[0]
    return system, trajectory, system.sense(trajectory, made), made


@pytest.mark.slow
def test_a_box_falls_on_four_corners_and_does_not_turn():
    """Redundant contacts that close at once: no corner is first."""
    for restitution in (1.0, 0.6):
        numbers = {"dt": 4e-3, "steps": 300, "restitution": restitution, "friction": 0.0}
        system, trajectory, at, _ = box((0.4, 0.6, 0.2), position=(0, 0, 0.5), **numbers)
        # A tilt of rounding grows with every bounce, by the time of flight over the step.
        spin = np.abs(np.asarray(at.angular_velocity)).max(axis=1)
        assert spin[:150].max() <= 1e-12 and spin[:250].max() <= 1e-6
        z = np.asarray(at.position)[:, 2]
        # Of several contacts each gives way by a part in 10^9 of the way of a step.
        assert z.min() >= 0.1 - tol.SHARED_GAP * 4.5 * 4e-3
        assert z[80:200].max() - 0.1 == pytest.approx(0.4 * restitution**2, abs=2e-3)


@pytest.mark.slow
def test_a_tumbling_box_keeps_its_energy():
    """Corners that meet the floor one by one and two by two, at 20 rad/s; no energy is made in any step."""
    moving = {"velocity": (1.0, 0.2, -1.0), "angular_velocity": (3.0, -2.0, 1.0)}
    numbers = {"dt": 2e-3, "restitution": 1.0, "friction": 0.0, "position": (0, 0, 0.6)}
    system, trajectory, _, _ = box((0.4, 0.6, 0.2), **numbers, **moving)
    energy = np.asarray(system.energy(trajectory).total)
    assert np.abs(energy - energy[0]).max() <= tol.ENERGY_OF_A_STIFF_CONTACT * energy[0]
    momentum = np.asarray(system.momentum(trajectory))[:, :2]
    assert np.abs(momentum - momentum[0]).max() <= 1e-12 * np.abs(momentum).max()


@pytest.mark.slow
def test_a_box_slides_on_four_corners():
    """Dependent contacts share load and friction evenly: it does not turn, and stops where a point does."""
    moving = {"position": (0, 0, 0.1), "velocity": (3.0, 0, 0)}
    _, trajectory, at, _ = box((0.3, 0.3, 0.2), dt=0.01, steps=60, restitution=0.0, friction=0.9, **moving)
    assert int(trajectory.steps_rejected) == 0
    assert float(at.position[-1, 0]) == pytest.approx(9 / (2 * 0.9 * G), abs=1e-4)
    assert abs(float(at.velocity[-1, 0])) <= 1e-10


@pytest.mark.slow
def test_a_thrown_box_comes_to_rest():
    """Long flights, in which the impulses of friction decay beyond the smallest numbers, and then impacts."""
    moving = {"velocity": (1.0, -0.3, 0.5), "angular_velocity": (2.0, -1.0, 6.0)}
    numbers = {"dt": 2e-3, "restitution": 0.4, "friction": 0.4, "position": (0, 0, 0.3)}
    _, _, at, _ = box((0.1,) * 3, **numbers, **moving)
    assert np.abs(np.asarray(at.velocity)[-1]).max() <= 1e-9
    assert np.abs(np.asarray(at.angular_velocity)[-1]).max() <= 1e-8


@pytest.mark.slow
def test_a_box_rocks_from_edge_to_edge():
    """It goes on about the other edge, which rests, with the moment of momentum that it has about it."""
    half, height, tilt, h = 0.1, 0.2, np.radians(5.0), 2e-4
    lever = half * np.sin(tilt) + height * np.cos(tilt)
    place = {"position": (height * np.sin(tilt) - half * np.cos(tilt), 0, lever)}
    numbers = {"dt": h, "steps": 600, "restitution": 0.0, "friction": 0.6, "orientation": ((0, 1, 0), tilt)}
    system, trajectory, at, made = box((2 * half, 2 * half, 2 * height), **numbers, **place)
    # About an edge, by mass.
    central = (half**2 + height**2) / 3
    inertia = central + half**2 + height**2
    falling = np.sqrt(2 * G * (lever - height) / inertia)
    kept = (central + height**2 - half**2) / inertia
    turning = -np.asarray(at.angular_velocity)[:, 1]
    hit = int(np.argmax(turning))
    slowing = G * half / inertia * h  # in a step
    assert turning[hit] == pytest.approx(falling, abs=slowing)
    assert turning[hit + 1] == pytest.approx(kept * falling, abs=1.5 * slowing)
    edge = system.sense(trajectory, nc.Point(made, (-half, half, -height), local=True))
    assert np.abs(np.asarray(edge.velocity)[hit + 1 : 600]).max() <= 1e-3


def stack(sizes, places, on_planes=False, **last):
    """Boxes on the floor and on each other, or on planes of each other."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    below, law = FLOOR, {"restitution": 0.0, "friction": 0.5}
    for k, (size, place) in enumerate(zip(sizes, places)):
        moving = last if k == len(sizes) - 1 else {}
        made = scene.add(nc.RigidBody(shape=nc.Box(size), density=500.0, position=place, **moving))
        scene.add(nc.Contact(made, below, **law))
        top = np.asarray(place) + (0, 0, size[2] / 2)
        below = nc.Plane(normal=(0, 0, 1), point=top, body=made) if on_planes else made
    return scene.compile()


def assert_stands(system, state, steps):
    trajectory = nc.simulate(system, state, dt=5e-3, steps=steps)
    assert np.abs(np.asarray(trajectory.q) - np.asarray(state.q)).max() <= 1e-9
    assert int(trajectory.steps_rejected) == 0


CUBES = [(0.2,) * 3] * 2
STACKS = {
    "aligned": (CUBES, [(0, 0, 0.1), (0, 0, 0.3)], {}),
    "overhanging": (CUBES, [(0, 0, 0.1), (0.05, 0, 0.3)], {}),
    "turned": (CUBES, [(0, 0, 0.1), (0, 0, 0.3)], {"orientation": ((0, 0, 1), np.pi / 4)}),
    "crossed": ([(1.0, 0.2, 0.1), (0.2, 1.0, 0.1)], [(0, 0, 0.05), (0, 0, 0.15)], {}),
}


@pytest.mark.exhaustive
def test_boxes_on_boxes_stand():
    """On corners, on edges that cross, and on both: for two seconds nothing moves by more than rounding."""
    for sizes, places, turned in STACKS.values():
        assert_stands(*stack(sizes, places, **turned), steps=400)


@pytest.mark.exhaustive
def test_a_stack_on_planes_stands():
    """Ten seconds, dependent contacts one upon the other."""
    assert_stands(*stack([(0.2,) * 3] * 3, [(0, 0, 0.1 + 0.2 * k) for k in range(3)], True), steps=2000)


@pytest.mark.exhaustive
def test_a_stack_of_ten_boxes_stands():
    """For ten seconds, each on the one below, which it meets at its own corners and at those of the other.

    With a tenth of the compliance that they have, which of them carry the load changes from step to step,
    and the eighth ends the run.
    """
    assert_stands(*stack([(0.2,) * 3] * 10, [(0, 0, 0.1 + 0.2 * k) for k in range(10)]), steps=2000)


@pytest.mark.exhaustive
@pytest.mark.parametrize("contact", [{"restitution": 0.5, "friction": 0.3}, {"stiffness": 1e5}], ids=str)
def test_what_touches_at_rest(contact):
    """A gap of exactly zero without a load: nothing moves, and derivatives are numbers in both modes."""
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, 0.1)))
    scene.add(nc.Contact(ball, FLOOR, name="touch", **contact))
    system, state = scene.compile()

    def end(x):
        moved = eqx.tree_at(lambda s: s.v, state, state.v.at[0, 2].add(x))
        return nc.simulate(system, moved, dt=0.01, steps=5, throw=False).q[-1, 0, 2]

    assert float(end(0.0)) == 0.1
    assert np.isfinite(jax.grad(end)(0.0)) and np.isfinite(jax.jvp(end, (0.0,), (1.0,))[1])
    report = nc.contacts(system, nc.simulate(system, state, dt=0.01, steps=5))
    assert any(note.startswith("grazing: touch") for note in report.notes)


@pytest.mark.exhaustive
def test_edges_that_touch_with_nothing_between():
    """Crossed capsules from a gap of exactly zero, and from a distance: the speed passes on, as of points."""
    for offset in (0.0, 0.01):
        scene, shape = nc.Scene(), nc.Capsule(radius=0.05, length=0.6)
        one = scene.add(nc.RigidBody(shape=shape, density=500.0, orientation=((0, 1, 0), np.pi / 2)))
        place = {"position": (0, 0, 0.1 + offset), "velocity": (0, 0, -1.0)}
        other = {"shape": shape, "density": 500.0, "orientation": ((1, 0, 0), np.pi / 2), **place}
        other = scene.add(nc.RigidBody(**other))
        scene.add(nc.Contact(one, other, name="cross"))
        system, state = scene.compile()
        trajectory = nc.simulate(system, state, dt=3e-3, steps=20)
        assert_never_gains(system, trajectory)
        assert np.abs(np.asarray(system.sense(trajectory, other).velocity)[-1]).max() <= 1e-12
