"""Verification: rigid cases beside values made by others, by exact solutions or by other models.

`reference_cases.json` holds the numbers, their tolerances and origins. A method of order two reaches tight
tolerances by Richardson's formula from the steps h and h/2, which at the same time shows its order.
"""

import json
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from scipy.spatial.transform import Rotation

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.gallery.spacecraft import compare_torques

CASES = json.loads((Path(__file__).parents[1] / "reference_cases.json").read_text())


def reference(case: str, quantity: str, origin: str = "", until: float = np.inf) -> list[tuple]:
    """Entries (t, value, tolerance) of a quantity of a case, up to a time."""
    return [
        (entry["t"], entry["value"], entry["tol"])
        for entry in CASES[case]["reference"]
        if entry["quantity"] == quantity and entry["origin"].startswith(origin) and entry["t"] <= until
    ]


def march(system, state, dt: float, times, block: int):
    """States at some times, multiples of `block` steps; one compiled program for any step and time."""
    result, done = [], 0
    for t in sorted(times):
        wanted = round(t / dt / block)
        assert abs(wanted * block * dt - t) < 1e-9, "times must be multiples of the block"
        while done < wanted:
            run = nc.simulate(system, state, dt=dt, steps=block, save_every=block, extra_substeps=0)
            state = jax.tree.map(lambda x: x[-1], run.states)
            done += 1
        result.append(state)
    return result


def richardson(quantity, system, state, dt: float, times, block: int):
    """Values (times, ...) extrapolated from dt, dt/2 and dt/4, then those of dt and of dt/2.

    The error is a series in h^2: two steps remove the second order, the third removes the fourth.
    """
    first, second, third = (
        np.array([quantity(s) for s in march(system, state, h, times, block)]) for h in (dt, dt / 2, dt / 4)
    )
    coarse, fine = (4 * second - first) / 3, (4 * third - second) / 3
    return (16 * fine - coarse) / 15, first, second


def observed_order(coarse, fine, exact) -> float:
    """Exponent of the error between two steps, the second half the first."""
    return float(np.log2(np.linalg.norm(coarse - exact) / np.linalg.norm(fine - exact)))


def assert_agrees(result, entries) -> None:
    for value, (t, wanted, allowed) in zip(result, entries, strict=True):
        error = np.max(np.abs(np.asarray(value) - np.asarray(wanted)))
        assert error <= allowed, f"at t = {t} s off by {error:.1e}, allowed {allowed:.0e}"


def directors(state, body: int = 0):
    """Rotation matrix, directors as columns."""
    return np.asarray(state.q)[4 * body + 1 : 4 * body + 4].T


def body_rates(state, body: int = 0):
    """Angular velocity in body axes [rad/s]."""
    d, v = np.asarray(state.q)[4 * body + 1 : 4 * body + 4], np.asarray(state.v)[4 * body + 1 : 4 * body + 4]
    return d @ (0.5 * np.cross(d, v).sum(0))


def quaternion(matrix):
    """Scalar part first."""
    return np.roll(Rotation.from_matrix(matrix).as_quat(), 1)


def times(entries) -> list[float]:
    return [t for t, *_ in entries]


# --- tops -------------------------------------------------------------------------------------------------


@cache
def heavy_top():
    p = CASES["R01"]["params"]
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=p["g"]))
    spin = CASES["R01"]["setup"]["Omega0_body"]
    top = nc.RigidBody(mass=p["m"], inertia=p["J_com"], com=p["r_com"], angular_velocity=spin, name="top")
    body = scene.add(top)
    scene.add(nc.Spherical(nc.ground, body, point=(0.0, 0.0, 0.0)))
    return (*scene.compile(), body)


@pytest.mark.slow
def test_r01_heavy_top():
    """150 rad/s about the axis, two seconds: phase errors of 300 rad are extrapolated away."""
    system, state, _ = heavy_top()
    centre = reference("R01", "x_com", "own")

    def quantity(s):
        d = directors(s)
        return np.concatenate([d @ [0.0, 1.0, 0.0], d @ body_rates(s), body_rates(s)])

    result, coarse, fine = richardson(quantity, system, state, 1e-4, times(centre), 1000)
    assert_agrees(result[:, :3], centre)
    assert_agrees(result[-1:, 3:6], reference("R01", "omega_global"))
    assert_agrees(result[-1:, 4:5], [(2.0, [-106.1638041431], 1e-6)])
    assert_agrees(result[-1:, 7:], reference("R01", "Omega_body[1:]"))
    exact = np.array([value for _, value, _ in centre])
    order = observed_order(coarse[0, :3], fine[0, :3], exact[0])
    assert order == pytest.approx(tol.ORDER, abs=tol.ORDER_TOLERANCE)


@pytest.mark.exhaustive
def test_r01_energy_and_first_acceleration():
    system, state, top = heavy_top()
    (energy,) = [e for e in CASES["R01"]["reference"] if e["quantity"] == "energy"]
    assert float(system.energy(state).total) == pytest.approx(energy["value"], rel=energy["tol"])
    ((_, wanted, allowed),) = reference("R01", "acc_com0")
    centre = nc.Point(top, (0.0, 1.0, 0.0), local=True)
    result = system.sense(state, centre).acceleration
    assert np.max(np.abs(np.asarray(result) - wanted)) <= allowed * np.max(np.abs(wanted))


@pytest.mark.exhaustive
def test_r02_steady_precession():
    """The nutation angle stays, the precession runs at its rate; the spin rate is given to four digits."""
    p, setup = CASES["R02"]["params"], CASES["R02"]["setup"]
    tilt, rate = setup["alpha0"], setup["omega_p"]
    inertia, arm = p["J_principal"][0], p["M"] * p["l"] ** 2
    weight = p["M"] * p["g"] * p["l"]
    steady = (weight / rate + arm * rate * np.cos(tilt)) / inertia  # C w_s + (C - A') w_p cos = M g l / w_p
    assert steady == pytest.approx(setup["omega_s"], abs=0.05)
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, 0.0, -p["g"])))
    axis = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    top = nc.RigidBody(
        mass=p["M"],
        inertia=p["J_principal"],
        com=(0.0, 0.0, p["l"]),
        orientation=((1.0, 0.0, 0.0), tilt),
        angular_velocity=rate * np.array([0.0, 0.0, 1.0]) + steady * axis,
    )
    scene.add(nc.Spherical(nc.ground, scene.add(top), point=(0.0, 0.0, 0.0)))
    system, state = scene.compile()
    moments = [0.02, 0.04, 0.06, 0.08, 0.1]
    result, coarse, fine = richardson(lambda s: np.asarray(s.q)[3], system, state, 2e-4, moments, 100)
    turned = rate * np.array(moments)
    level, height = np.sin(tilt), np.full_like(turned, np.cos(tilt))
    exact = np.stack([np.sin(turned) * level, -np.cos(turned) * level, height], axis=1)
    assert np.max(np.abs(result - exact)) <= tol.EXACT_SOLUTION
    assert observed_order(coarse, fine, exact) == pytest.approx(tol.ORDER, abs=tol.ORDER_TOLERANCE)


@cache
def free_body(case: str):
    p = CASES[case]
    scene = nc.Scene()
    spin = p["setup"]["Omega0"]
    scene.add(nc.RigidBody(mass=1.0, inertia=p["params"]["J"], angular_velocity=spin, name="body"))
    return scene.compile()


@pytest.mark.slow
def test_r10_free_body():
    system, state = free_body("R10")
    rates, pose = reference("R10", "Omega"), reference("R10", "q")

    def quantity(s):
        return np.concatenate([body_rates(s), quaternion(directors(s))])

    result, coarse, fine = richardson(quantity, system, state, 2.5e-4, times(rates), 200)
    signs = np.sign([result[k, 3:] @ value for k, (_, value, _) in enumerate(pose)])
    assert_agrees(result[:, :3], rates)
    assert_agrees(signs[:, None] * result[:, 3:], pose)
    exact = np.array([value for _, value, _ in rates])
    order = observed_order(coarse[:, :3], fine[:, :3], exact)
    assert order == pytest.approx(tol.ORDER, abs=tol.ORDER_TOLERANCE)
    last = march(system, state, 2.5e-4, [1.0], 200)[-1]
    assert np.max(np.abs(system.angular_momentum(last) - jnp.array([60.0, 160.0, 60.0]))) <= 1e-11 * 160


@pytest.mark.slow
def test_r12_dzhanibekov():
    """The flip of a spin about the middle axis; at t = 10 round-off is amplified."""
    system, state = free_body("R12")
    rates = reference("R12", "Omega")
    result, *_ = richardson(body_rates, system, state, 5e-4, times(rates), 200)
    assert_agrees(result, rates)


# --- pendulums --------------------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_r03_simple_pendulum():
    """A point mass on a massless rod."""
    p = CASES["R03"]["params"]
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, -p["g"], 0.0)))
    ball = scene.add(nc.PointMass(mass=p["m"], position=(-p["L"], 0.0, 0.0)))
    scene.add(nc.Distance(nc.ground, ball, parent_point=(0.0, 0.0, 0.0)))
    system, state = scene.compile()
    entries = reference("R03", "xy")
    result, coarse, fine = richardson(
        lambda s: np.asarray(s.q)[0, :2], system, state, 1e-3, times(entries), 1000
    )
    assert_agrees(result, entries)
    exact = np.array([value for _, value, _ in entries])
    assert observed_order(coarse[0], fine[0], exact[0]) == pytest.approx(tol.ORDER, abs=tol.ORDER_TOLERANCE)


@pytest.mark.exhaustive
def test_r13_double_pendulum():
    p = CASES["R13"]["params"]
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, 0.0, -p["g"])))
    carrier = nc.ground
    for k in range(2):
        start = (k * p["L"], 0.0, 0.0)
        rod = nc.RigidBody(
            mass=p["m"],
            second_moment=(p["m"] * p["L"] ** 2 / 3, 0.0, 0.0),
            com=(p["L"] / 2, 0.0, 0.0),
            position=start,
        )
        body = scene.add(rod)
        scene.add(nc.Revolute(carrier, body, point=start, axis=(0.0, 1.0, 0.0)))
        carrier = body
    system, state = scene.compile()
    entries = reference("R13", "tip_xz", until=3.0)

    def tip(s):
        q = np.asarray(s.q)
        return (q[4] + p["L"] * q[5])[[0, 2]]

    result, coarse, fine = richardson(tip, system, state, 5e-4, times(entries), 500)
    assert_agrees(result, entries)
    exact = np.array([value for _, value, _ in entries])
    assert observed_order(coarse[0], fine[0], exact[0]) == pytest.approx(tol.ORDER, abs=tol.ORDER_TOLERANCE)


@pytest.mark.exhaustive
def test_r14_four_particles():
    """Bars and quartic springs; the stored positions are those of another scheme, within 5e-5 of this one."""
    p = CASES["R14"]["params"]
    scene = nc.Scene()
    balls = []
    for k, (mass, place) in enumerate(zip(p["m"], p["r0"], strict=True)):
        speed = CASES["R14"]["setup"]["v4"] if k == 3 else (0.0, 0.0, 0.0)
        balls.append(scene.add(nc.PointMass(mass=mass, position=place, velocity=speed, name=f"r{k + 1}")))
    for i, j in p["bars"]:
        ends = balls[i - 1], balls[j - 1]
        scene.add(nc.Distance(*ends, point=p["r0"][j - 1], parent_point=p["r0"][i - 1]))
    for spring in p["springs"]:
        i, j = spring["i"] - 1, spring["j"] - 1
        ends = nc.Point(balls[i], p["r0"][i]), nc.Point(balls[j], p["r0"][j])
        scene.add(nc.QuadraticSpring(ends, stiffness=spring["k"], length=p["l0"]))
    system, state = scene.compile()
    h, end = CASES["R14"]["setup"]["h"], CASES["R14"]["setup"]["t_end"]
    trajectory = nc.simulate(system, state, dt=h, steps=round(end / h))
    for k in range(4):
        ((_, wanted, _),) = reference("R14", f"r{k + 1}")
        result = trajectory.q[-1, 4 * system.body_index(f"r{k + 1}")]
        assert np.max(np.abs(np.asarray(result) - wanted)) <= tol.OTHER_SCHEME
    energy = system.energy(trajectory).total
    assert np.max(np.abs(energy - energy[0])) <= tol.ENERGY * float(energy[0])


@pytest.mark.slow
def test_r16_revolute_pendulum_and_its_reaction():
    p = CASES["R16"]["params"]
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, 0.0, -p["g"])))
    arm = nc.RigidBody(mass=p["m"], inertia=p["J"], position=(p["length"] / 2, 0.0, 0.0), name="bar")
    hinge = scene.add(nc.Revolute(nc.ground, scene.add(arm), point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)))
    system, state = scene.compile()
    entries = reference("R16", "pos", "own")

    def quantity(s):
        return np.concatenate([np.asarray(s.q)[0], np.asarray(system.sense(s, hinge).force)])

    result, coarse, fine = richardson(quantity, system, state, 5e-4, times(entries), 500)
    places = result[:, :3]
    assert_agrees(places, entries)
    assert_agrees(places, reference("R16", "pos", "source"))
    exact = np.array([value for _, value, _ in entries])
    order = observed_order(coarse[:, :3], fine[:, :3], exact)
    assert order == pytest.approx(tol.ORDER, abs=tol.ORDER_TOLERANCE)
    ((t, force, allowed),) = reference("R16", "force on the pendulum at the pin")
    at = times(entries).index(t)
    assert np.max(np.abs(result[at, 3:6] - force)) <= allowed * np.max(np.abs(force))


# --- loops ------------------------------------------------------------------------------------------------


@cache
def four_bars():
    example = gallery.load("four_bar")
    return example.system, example.state


def tip_of_first_rod(system):
    body = 4 * system.body_index("upright 0")

    def tip(s):
        d = np.asarray(s.q)[body + 1 : body + 4]
        return (np.asarray(s.q)[body] + d[1])[:2]

    return tip


@pytest.mark.exhaustive
def test_r04_four_bars_pass_singular_positions():
    """Two loops, flat at a quarter turn: a lesser solver takes another branch there or stops."""
    system, state = four_bars()
    entries = reference("R04", "B0_xy", until=2.0)
    result, *_ = richardson(tip_of_first_rod(system), system, state, 2e-3, times(entries), 250)
    assert_agrees(result, entries)


@pytest.mark.exhaustive
def test_r04_four_bars_over_ten_seconds():
    system, state = four_bars()
    entries = reference("R04", "B0_xy")
    result, *_ = richardson(tip_of_first_rod(system), system, state, 1e-3, times(entries), 250)
    assert_agrees(result, entries)


@cache
def bricard():
    example = gallery.load("bricard")
    return example.system, example.state


def corner(system):
    body = 4 * system.body_index("rod 4")
    return lambda s: np.asarray(s.q)[body]


@pytest.mark.slow
def test_r06_bricard():
    """One constraint too many everywhere; the motion is that of the one degree of freedom there is."""
    system, state = bricard()
    entries = reference("R06", "P3", until=2.0)
    result, *_ = richardson(corner(system), system, state, 2e-3, times(entries), 250)
    assert_agrees(result, entries)
    assert float(system.energy(state).total) == pytest.approx(-29.43, abs=1e-9)


@pytest.mark.exhaustive
def test_r06_bricard_over_ten_seconds():
    system, state = bricard()
    entries = reference("R06", "P3")
    result, *_ = richardson(corner(system), system, state, 1e-3, times(entries), 250)
    assert_agrees(result, entries)


# --- the spacecraft of the paper (8.1) --------------------------------------------------------------------

# From rest, three motors of 200 N m over 5 s in N steps: the digits on which two prototypes agree, each with
# half a unit of the last one. N: J_3(5) covariant (70), T(5) contravariant (61), T(5) covariant (70).
TABLE = {
    5: ((-336, 0.5), (7208.728, 0.0005), (3103.4, 0.05)),
    10: ((-212, 0.5), (7626.4, 0.05), (4926.3, 0.05)),
    20: ((-91.3, 0.05), (7788.9, 0.05), (6584.6, 0.05)),
    40: ((-28.6, 0.05), (7825.0, 0.05), (7443.3, 0.05)),
    80: ((-7.65, 0.005), (7833.428, 0.0005), (7730.8, 0.05)),
}
FINE = (1000, 7836.16535, 0.000005)
CONVERGED = 7836.18288  # Runge-Kutta of order 4, independent of this library [J]


def test_both_torque_formulas_of_the_paper():
    """All numbers of steps are lanes of one program; contravariant torques keep the angular momentum."""
    runs = {(run.formula, run.steps): run for run in compare_torques(tuple(TABLE))}
    wrong = []
    for steps, (momentum, energy, covariant) in TABLE.items():
        right, other = runs["contravariant", steps], runs["covariant", steps]
        pairs = ((other.angular_momentum[-1], momentum), (right.energy[-1], energy))
        for number, (value, digit) in (*pairs, (other.energy[-1], covariant)):
            if abs(number - value) > digit:
                wrong.append(f"N = {steps}: {number}, not {value}")
        if np.max(np.abs(right.angular_momentum)) > tol.SPACECRAFT_MOMENTUM:
            wrong.append(f"N = {steps}: angular momentum is not kept")
    assert not wrong


@pytest.mark.exhaustive
def test_all_components_of_angular_momentum_and_the_converged_energy():
    steps, energy, digit = FINE
    example = gallery.load("spacecraft")
    trajectory = example.simulate(steps=steps, dt=5.0 / steps)
    system = example.system
    assert np.max(np.abs(system.angular_momentum(trajectory))) <= tol.SPACECRAFT_MOMENTUM
    assert abs(float(system.energy(trajectory).total[-1]) - energy) <= digit
    # Richardson's formula for order two leaves the fourth order of the coarse run, a hundredth of the gap
    coarse = TABLE[80][1][0]
    assert abs(energy + (energy - coarse) / ((steps / 80) ** 2 - 1) - CONVERGED) < 0.02 * (CONVERGED - energy)
