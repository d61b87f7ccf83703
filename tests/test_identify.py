"""Numbers from measured motions: against SciPy, how often intervals cover truth, what data do not tell."""

import io
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import curve_fit

import natcoord_jax as nc

DT, STEPS, NOISE = 0.01, 200, 0.01
TRUTH = {"stiffness": 2.5, "damping": 0.08}
STIFFNESS = nc.Parameter(
    "stiffness", apply=lambda system, k: system.set("spring", stiffness=k), value=1.0, lower=0.01
)
DAMPING = nc.Parameter(
    "damping", apply=lambda system, c: system.set("damper", damping=c), value=0.01, lower=0.0
)
BOTH = (STIFFNESS, DAMPING)
PUSH = nc.InitialRate("hinge")


def pendulum():
    """A pendulum with a spring and a damper, let go at 1.2 rad."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rod = scene.add(nc.RigidBody(mass=1.2, inertia=(0.03, 0.03, 0.001), com=(0, 0, -0.3), name="rod"))
    hinge = scene.add(nc.Revolute(nc.ground, rod, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointSpring(hinge, stiffness=1.0, name="spring"))
    scene.add(nc.JointDamper(hinge, damping=0.01, name="damper"))
    system, state = scene.compile()
    return system, system.with_coordinate(state, hinge, 1.2), rod


@pytest.fixture(scope="module")
def swinging():
    return pendulum()[:2]


def with_values(system, values):
    for parameter, value in zip(BOTH, values):
        system = parameter.applied(system, jnp.asarray(value))
    return system


def angles(system, start, values=None):
    """Exact ones (samples, 1)."""
    run = nc.simulate(with_values(system, values or TRUTH.values()), start, dt=DT, steps=STEPS)
    return np.asarray(system.coordinate(run, "hinge"))[:, None]


def noisy(exact, seed=0, size=NOISE, missing=0.1):
    """With noise, and without some of it."""
    rng = np.random.default_rng(seed)
    found = exact + size * rng.standard_normal(exact.shape)
    found[rng.uniform(size=exact.shape) < missing] = np.nan
    return found


def identified(swinging, measured, parameters=BOTH, sensors="hinge", **options):
    return nc.identify(*swinging, parameters, measured, sensors, dt=DT, **options)


def off(found, truth=TRUTH):
    """Of each value, in deviations."""
    return np.array([(found.values[name] - truth[name]) / found.deviations[name] for name in truth])


# --- what is refused --------------------------------------------------------------------------------------


def test_what_cannot_be_identified_is_refused_with_its_remedy(swinging):
    fine = np.zeros((5, 1))
    outside = nc.Parameter("damping", apply=lambda s, c: s, value=0.5, lower=1.0)
    for words, measured, options in (
        (r"measured has shape \(1, 1\).*two samples", fine[:1], {}),
        ("measured has infinite numbers", fine + np.inf, {}),
        ("pass some, each with its own", fine, {"parameters": ()}),
        ("names .*'damping', 'damping'", fine, {"parameters": (DAMPING, DAMPING)}),
        (
            "'damping' is 0.5 where the search begins, outside of its bounds 1",
            fine,
            {"parameters": (outside,)},
        ),
        ("guess has 'mass'; the unknowns are stiffness, damping", fine, {"guess": {"mass": 1.0}}),
        ("noise is 0.0; pass a positive", fine, {"noise": 0.0}),
        (r"inputs has shape \(4, 1\)", fine, {"inputs": np.zeros((4, 1))}),
        ("no joint 'elbow'", fine, {"parameters": (nc.InitialCoordinate("elbow"),)}),
    ):
        with pytest.raises(ValueError, match=words):
            identified(swinging, measured, **options)
    system, start = swinging
    three = jax.tree.map(lambda x: np.stack([x] * 3), start)
    with pytest.raises(ValueError, match=r"leading axes \(3,\), and measured 2 experiments"):
        nc.identify(system, three, BOTH, np.zeros((2, 5, 1)), "hinge", dt=DT)


def test_an_unknown_of_the_start_has_room_and_a_first_value():
    with pytest.raises(ValueError, match="'hinge'.* the lower bound 2 is not below the upper bound 1"):
        nc.InitialRate("hinge", lower=2.0, upper=1.0)
    with pytest.raises(TypeError, match="InitialState: value is missing"):
        nc.InitialState("push", apply=lambda system, state, value: state)


@pytest.mark.exhaustive
def test_channels_that_do_not_fit_the_sensors_are_named(swinging):
    for words, measured, options in (
        (r"measured has 2 channels, and the sensors 1: 'hinge' \[rad\]", np.zeros((5, 2)), {}),
        (r"no number at all of 'hinge' \[rad\]", np.full((5, 1), np.nan), {}),
        ("measured has 2 numbers for 2 unknowns, stiffness, damping", np.zeros((2, 1)), {}),
        (r"noise has shape \(2,\)", np.zeros((5, 1)), {"noise": (0.1, 0.2)}),
        ("noise of a channel is 0", np.zeros((5, 1)), {"noise": (0.0,)}),
        (
            r"returns shape \(2, 1\); return .*here \(5, ch",
            np.zeros((5, 1)),
            {"sensors": lambda s, r: jnp.ones((2, 1))},
        ),
        (r"returns shape \(\)", np.zeros((5, 1)), {"sensors": lambda s, r: 1.0}),
    ):
        with pytest.raises(ValueError, match=words):
            identified(swinging, measured, **options)


# --- what is found ----------------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_values_and_covariance_are_those_of_scipys_curve_fit(swinging):
    """Which has its derivatives by differences, and no missing numbers."""
    measured = noisy(angles(*swinging))
    there = np.isfinite(measured)
    found = identified(swinging, measured, noise=NOISE)
    values, covariance = curve_fit(
        lambda _, *values: angles(*swinging, values)[there], None, measured[there], (2.0, 0.1),
        sigma=np.full(there.sum(), NOISE), absolute_sigma=True, epsfcn=1e-10, xtol=1e-12, ftol=1e-12,
    )  # fmt: skip
    assert found.ok and found.freedom == there.sum() - 2
    np.testing.assert_allclose(list(found.values.values()), values, rtol=1e-6)
    size = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.correlation, covariance / size / size[:, None], atol=1e-4)
    np.testing.assert_allclose(list(found.deviations.values()), size, rtol=1e-4)
    np.testing.assert_array_equal(np.isnan(found.residuals), ~there)
    assert found.cost == pytest.approx(np.nansum((found.residuals / NOISE) ** 2) / 2)
    assert np.all(np.abs(off(found)) < 3)
    # Without its size the noise is that of the residuals, and deviations are in proportion.
    again = identified(swinging, measured)
    assert again.noise[0] == pytest.approx(np.sqrt(np.nansum(again.residuals**2) / again.freedom))
    np.testing.assert_allclose(again.covariance, found.covariance * (again.noise[0] / NOISE) ** 2, rtol=1e-6)


@pytest.mark.exhaustive
def test_intervals_cover_the_truth_as_often_as_they_say(swinging):
    exact, truth, seeds = angles(*swinging), TRUTH | {PUSH.name: 0.0}, 200
    inside = []
    for seed in range(seeds):
        found = identified(swinging, noisy(exact, seed), (*BOTH, PUSH))
        assert found.ok, found.explain()
        inside.append([low <= truth[name] <= high for name, (low, high) in found.interval(0.95).items()])
    # Three deviations of a binomial of 200 are 4.6 %.
    rates = np.mean(inside, axis=0)
    assert np.all(np.abs(rates - 0.95) < 3 * np.sqrt(0.95 * 0.05 / seeds)), rates


@pytest.mark.exhaustive
def test_channels_weigh_by_their_noise_which_is_estimated(swinging):
    """An angle and a bad rate, of every second step."""
    system, start = swinging
    truth = with_values(system, TRUTH.values())

    def rate(system, run):
        return system.rate(run, "hinge")

    sensors = ("hinge", rate)
    run = nc.simulate(truth, start, dt=DT, steps=STEPS, save_every=2)
    exact = np.stack([system.coordinate(run, "hinge"), system.rate(run, "hinge")], axis=1)
    sizes = np.array([1e-3, 0.5])
    measured = noisy(exact, size=sizes)
    found = identified(swinging, measured, sensors=sensors, save_every=2)
    np.testing.assert_allclose(found.noise, sizes, rtol=0.2)
    assert found.labels == ("'hinge' [rad]", "channel 2") and np.all(np.abs(off(found)) < 3)
    given = identified(swinging, measured, sensors=sensors, save_every=2, noise=found.noise)
    np.testing.assert_allclose(list(given.values.values()), list(found.values.values()), rtol=1e-4)
    # The bad channel tells next to nothing, and does no harm.
    alone = identified(swinging, measured[:, :1], save_every=2)
    assert found.deviations["stiffness"] == pytest.approx(alone.deviations["stiffness"], rel=0.05)


@pytest.mark.exhaustive
def test_sensors_are_joints_points_and_functions_whose_channels_follow_each_other(swinging):
    system, start, rod = pendulum()
    place = nc.Point(rod, (0.0, 0.0, -0.6), local=True)
    run = nc.simulate(with_values(system, TRUTH.values()), start, dt=DT, steps=STEPS)
    exact = np.concatenate([angles(system, start), system.sense(run, place).position], axis=1)
    found = identified(swinging, exact, sensors=[system.structure.joints[0], place])
    assert found.labels[:2] == ("'hinge' [rad]", "point of 'rod', x [m]") and found.residuals.shape == (
        201,
        4,
    )
    np.testing.assert_allclose(list(found.values.values()), list(TRUTH.values()), rtol=1e-7)


@pytest.mark.exhaustive
def test_exact_data_give_exact_values(swinging):
    found = identified(swinging, angles(*swinging))
    np.testing.assert_allclose(list(found.values.values()), list(TRUTH.values()), rtol=1e-9)
    assert found.ok and "noise alone" not in found.explain()
    np.testing.assert_allclose(
        angles(found.system, found.state, found.values.values()), angles(*swinging), atol=1e-9
    )
    assert float(found.system.get("spring", "stiffness")) == found.values["stiffness"]


@pytest.mark.exhaustive
def test_information_of_several_experiments_adds_up(swinging):
    """Of other starts and lengths; what is not known of a start is known from its own experiment only."""
    system, start = swinging
    starts = [
        system.with_coordinate(start, "hinge", angle, rate=rate) for angle, rate in ((1.2, 0.3), (0.5, -1.0))
    ]
    measured = np.stack([noisy(angles(system, one), seed, missing=0) for seed, one in enumerate(starts)])
    measured[1, 120:] = np.nan
    assumed = [
        system.with_coordinate(one, "hinge", float(system.coordinate(one, "hinge")), rate=0.0)
        for one in starts
    ]
    states = jax.tree.map(lambda *x: np.stack(x), *assumed)
    both = nc.identify(system, states, (PUSH, *BOTH), measured, "hinge", dt=DT, noise=NOISE)
    pushes = [f"{PUSH.name}, experiment {k}" for k in range(2)]
    assert both.names == ("stiffness", "damping", *pushes) and both.freedom == 201 + 120 - 4
    assert np.all(np.abs(off(both, TRUTH | dict(zip(pushes, (0.3, -1.0))))) < 3.5)
    assert both.residuals.shape == measured.shape and both.state.t.shape == (2,)
    rates = system.rate(both.state, "hinge")
    np.testing.assert_allclose(rates, [both.values[push] for push in pushes], rtol=1e-9)
    each = [
        nc.identify(system, one, (*BOTH, PUSH), data, "hinge", dt=DT, noise=NOISE)
        for one, data in zip(assumed, measured)
    ]
    known = sum(np.linalg.inv(one.covariance[:2, :2]) for one in each)
    np.testing.assert_allclose(np.linalg.inv(both.covariance[:2, :2]), known, rtol=0.1)


@pytest.mark.exhaustive
def test_from_several_starts_the_least_is_found(swinging):
    """A spring whose stiffness begins far off ends where the oscillation is a turn behind."""
    far = (nc.Parameter("stiffness", apply=STIFFNESS.apply, value=300.0, lower=0.1, upper=1000.0), DAMPING)
    measured = noisy(angles(*swinging))
    alone = identified(swinging, measured, far)
    found = identified(swinging, measured, far, starts=8)
    assert abs(alone.values["stiffness"] - 2.5) > 1.0 and np.all(np.abs(off(found)) < 3)
    assert len(found.starts) == 8 and found.ok
    least = min(start.cost for start in found.starts)
    assert (
        found.starts[0].cost > 10 * least and found.starts[0].values["stiffness"] == alone.values["stiffness"]
    )
    assert "of 8 starts ended at the least cost" in found.explain()
    # A short part of the motion leads there, too.
    start = np.where(np.arange(STEPS + 1)[:, None] < 30, measured, np.nan)
    again = identified(swinging, measured, far, guess=identified(swinging, start, far))
    assert again.starts[0].cost == pytest.approx(least, rel=1e-6) and again.evaluations < 9


@pytest.mark.exhaustive
def test_the_start_of_a_loop_is_assembled_about_what_is_not_known():
    points = [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.5, 0.0, 1.2), (1.5, 0.0, 0.0)]
    scene = nc.Scene()
    bars = [scene.add(nc.RigidBody(mass=1.3, inertia=(0.2, 0.3, 0.4), position=x)) for x in points[:3]]
    line = [nc.ground, *bars, nc.ground]
    for k, point in enumerate(points):
        scene.add(nc.Revolute(line[k], line[k + 1], point=point, axis=(0, 1, 0), name=f"hinge {k}"))
    scene.add(nc.Gravity())
    system, state = scene.compile()
    start = nc.assemble(system, system.with_coordinate(state, "hinge 0", 0.05, rate=0.7))
    exact = system.coordinate(nc.simulate(system, start, dt=0.01, steps=20), "hinge 0")

    def at_angle(system, state, angle):
        return system.with_coordinate(state, "hinge 0", angle)

    unknown = nc.InitialState("angle", apply=at_angle, value=0.0), nc.InitialRate("hinge 0")
    found = nc.identify(system, state, unknown, exact, "hinge 0", dt=0.01)
    assert found.ok and found.values == pytest.approx({"angle": 0.05, unknown[1].name: 0.7}, rel=1e-7)
    errors = system.constraint_errors(found.state)
    assert errors.position < 1e-12 and errors.velocity < 1e-12


@pytest.mark.exhaustive
def test_a_length_that_moves_the_start_is_found(swinging):
    system, start = swinging

    def with_length(system, length):
        """Of the rod, from the hinge to its reference."""
        return system.set("hinge", frames=system.get("hinge", "frames").at[1, 0, 3].set(length))

    real = with_length(system, 0.2)
    run = nc.simulate(real, nc.assemble(real, start), dt=DT, steps=STEPS)
    length = nc.Parameter("length", apply=with_length, value=0.0, lower=-0.5, upper=0.5, moves=True)
    found = identified(swinging, noisy(np.asarray(system.coordinate(run, "hinge"))), (length,))
    assert found.ok and np.abs(off(found, {"length": 0.2})) < 3
    assert found.system.constraint_errors(found.state).position < 1e-12


# --- machines ---------------------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_masses_and_friction_of_an_arm_from_encoders_and_torques():
    """Three joints under a controller; a tenth of the numbers is missing."""
    scene, joints, below, height = nc.Scene(), [], nc.ground, 0.0
    scene.add(nc.Gravity())
    for k, (axis, mass, length) in enumerate(zip(np.eye(3)[[2, 1, 1]], (4.0, 3.0, 2.0), (0.4, 0.4, 0.3))):
        place = {"com": (0, 0, length / 2), "position": (0, 0, height)}
        link = scene.add(nc.RigidBody(mass=mass, inertia=(0.06, 0.06, 0.06), name=f"link {k}", **place))
        joint = scene.add(nc.Revolute(below, link, point=(0, 0, height), axis=axis, name=f"joint {k}"))
        scene.add(nc.JointDamper(joint, damping=0.5, name=f"viscous {k}"))
        scene.add(nc.JointFriction(joint, friction=0.5, slip=0.05, name=f"dry {k}"))
        scene.add(nc.JointTorque(joint, name=f"motor {k}"))
        joints, below, height = [*joints, joint], link, height + length
    system, start = scene.compile()
    rest = np.array([0.0, 0.6, 0.8])
    for joint, angle in zip(joints, rest):
        start = system.with_coordinate(start, joint, angle)

    def controller(t, state):
        wish = rest + jnp.array([0.8, 0.5, 0.7]) * jnp.sin(jnp.array([2.1, 2.9, 4.3]) * t)
        angle = jnp.stack([system.coordinate(state, joint) for joint in joints])
        rate = jnp.stack([system.rate(state, joint) for joint in joints])
        return jnp.array([40.0, 80.0, 30.0]) * (wish - angle) - jnp.array([4.0, 6.0, 2.0]) * rate

    def torques(system, run):
        """Of the step before each sample; of the first there is none."""
        return jnp.concatenate([run.inputs[:1], run.inputs])

    def of_part(part, field, value):
        apply = lambda system, x: system.set(part, **{field: x})  # noqa: E731
        return nc.Parameter(f"{field} of {part}", apply=apply, value=value, lower=0.0)

    unknown = [of_part(f"link {k}", "mass", value) for k, value in ((1, 3.0), (2, 2.0))]
    unknown += [of_part(f"viscous {k}", "damping", 0.5) for k in range(3)]
    unknown += [of_part(f"dry {k}", "friction", 0.5) for k in range(3)]
    truth = dict(zip((x.name for x in unknown), (3.6, 2.7, 0.9, 0.7, 0.3, 1.2, 0.8, 0.4)))
    real = system
    for parameter in unknown:
        real = parameter.applied(real, jnp.asarray(truth[parameter.name]))
    run = nc.simulate(real, start, dt=0.01, steps=300, inputs=controller)
    sizes = np.repeat([1e-3, 0.2], 3)
    measured = noisy(np.concatenate([run.states.coordinates, torques(real, run)], axis=1), size=sizes)
    measured[0, 3:] = np.nan
    found = nc.identify(system, start, unknown, measured, [*joints, torques], dt=0.01, inputs=controller)
    assert found.ok and np.all(np.abs(off(found, truth)) < 3.5), found.explain()
    np.testing.assert_allclose(found.noise, sizes, rtol=0.2)
    assert max(found.deviations[name] / truth[name] for name in truth) < 0.1


@pytest.mark.exhaustive
def test_modulus_and_damping_of_a_ruler_from_its_ringing():
    """A cantilever that a hammer has struck, its tip seen by a laser."""
    modulus, scene = 1.5e11, nc.Scene()
    section = nc.RectangularSection(width=0.02, height=0.001, E=modulus, nu=0.3, density=7800.0)
    line = [(0, 0, 0), (0.5, 0, 0)]
    ruler = scene.add(
        nc.Beam(section, line, second=(0, 1, 0), elements=3, start=nc.ground, damping=1e-3, name="ruler")
    )
    up = nc.Direction(nc.ground, (0, 0, 1))
    scene.add(nc.BodyForceInput((nc.Point(ruler.end, (0.5, 0, 0)), up), name="hammer"))
    system, state = scene.compile()
    unit, dampers = (
        system.get(ruler.elements, "stiffness") / modulus,
        [f"ruler/damping {k}" for k in range(3)],
    )

    def with_modulus(system, E):
        return system.set(ruler.elements, stiffness=E * unit)

    def with_damping(system, time):
        return system.set(dampers, viscosity=time * system.get(ruler.elements, "stiffness"))

    def laser(system, run):
        return system.sense(run, nc.Point(ruler.end, local=True)).position[:, 2]

    unknown = (
        nc.Parameter("E", apply=with_modulus, value=modulus, lower=1e10, upper=1e12),
        nc.Parameter("damping", apply=with_damping, value=1e-3, lower=1e-5, upper=1.0),
    )
    blow = np.zeros((200, 1))
    blow[:4] = 0.3
    real = with_damping(with_modulus(system, 2.05e11), 3e-3)
    ringing = np.asarray(laser(real, nc.simulate(real, state, dt=5e-3, inputs=blow)))
    found = nc.identify(system, state, unknown, noisy(ringing, size=2e-4), laser, dt=5e-3, inputs=blow)
    assert found.ok and np.all(np.abs(off(found, {"E": 2.05e11, "damping": 3e-3})) < 3), found.explain()
    assert found.deviations["E"] < 1e-3 * 2.05e11 and found.deviations["damping"] < 0.02 * 3e-3
    assert found.residuals.shape == ringing[:, None].shape


# --- what the data do not tell ----------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_what_the_channels_do_not_depend_on_is_named(swinging):
    """One unknown that does nothing, and two of which only the sum acts."""
    measured = noisy(angles(*swinging))
    idle = nc.Parameter("idle", apply=lambda system, x: system, value=2.0)
    more = nc.Parameter(
        "more",
        apply=lambda system, k: system.set("spring", stiffness=system.get("spring", "stiffness") + k),
        value=0.0,
    )
    found = identified(swinging, measured, (*BOTH, more, idle))
    assert found.outcome is nc.Outcome.UNDETERMINED and not found.ok
    known = identified(swinging, measured)
    assert found.deviations["damping"] == pytest.approx(known.deviations["damping"], rel=0.01)
    assert all(np.isinf(found.deviations[name]) for name in ("stiffness", "more", "idle"))
    assert found.values["idle"] == 2.0 and np.all(np.isnan(found.correlation[3, :3]))
    together = found.values["stiffness"] + found.values["more"]
    assert together == pytest.approx(known.values["stiffness"], rel=1e-4)
    assert sorted(map(sorted, found.undetermined)) == [["idle"], ["more", "stiffness"]]
    pair = next(change for change in found.undetermined if len(change) == 2)
    assert pair["more"] == pytest.approx(-pair["stiffness"], rel=1e-3)
    assert "not determined" in found.explain() and "leave out one" in found.explain()


@pytest.mark.exhaustive
def test_a_bound_that_excludes_the_truth_holds_and_is_told(swinging):
    less = nc.Parameter("damping", apply=DAMPING.apply, value=0.01, lower=0.0, upper=0.05)
    found = identified(swinging, noisy(angles(*swinging)), (STIFFNESS, less))
    assert found.ok and found.at_bounds == {"damping": "upper"} and found.values["damping"] == 0.05
    assert found.interval()["damping"][1] == 0.05
    # What is left is no noise.
    assert found.memory[0] > 0.9 and "upper bound" in found.explain() and "lacks something" in found.explain()
    free = identified(swinging, noisy(angles(*swinging)))
    assert abs(free.memory[0]) < 3 / np.sqrt(STEPS) and not free.at_bounds


@pytest.mark.exhaustive
def test_points_that_cannot_be_simulated_are_refused(swinging):
    """A damper is never negative, which an unknown without bounds does not know."""
    free = nc.Parameter("damping", apply=DAMPING.apply, value=0.5)
    found = identified(swinging, noisy(angles(*swinging, (2.5, 0.0))), (STIFFNESS, free))
    assert found.refused > 0 and found.values["damping"] >= 0 and found.deviations["damping"] < 1e-3
    lost = identified(
        swinging, noisy(angles(*swinging)), (STIFFNESS, nc.Parameter("d", apply=DAMPING.apply, value=-0.5))
    )
    assert lost.outcome is nc.Outcome.SIMULATION_FAILED and not lost.ok
    assert "where the search begins" in lost.explain() and "begin with other values" in lost.explain()


# --- programs and interruptions ---------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_other_numbers_compile_nothing(swinging, programs):
    exact = angles(*swinging)
    identified(swinging, noisy(exact))
    system, start = pendulum()[:2]
    heavier = system.set("rod", mass=1.3), system.with_coordinate(start, "hinge", 1.1)
    programs.clear()
    other = (
        nc.Parameter("stiffness", apply=STIFFNESS.apply, value=1.5, lower=0.02, upper=50.0),
        nc.Parameter("damping", apply=DAMPING.apply, value=0.02),
    )
    for options in ({"noise": 0.02}, {"parameters": other, "max_evaluations": 7}):
        identified(swinging, noisy(exact, seed=1), **options)
    nc.identify(*heavier, BOTH, noisy(exact), "hinge", dt=0.011)
    assert not programs


@pytest.mark.exhaustive
def test_it_ends_where_it_is_told_to(swinging, monkeypatch):
    class Impatient(io.StringIO):
        """Interrupts where the third evaluation is shown."""

        def write(self, text):
            super().write(text)
            if text.startswith("evaluation 3"):
                raise KeyboardInterrupt

    measured = noisy(angles(*swinging))
    stopped = identified(swinging, measured, max_evaluations=2)
    assert stopped.outcome is nc.Outcome.MAX_ITERATIONS and "more evaluations" in stopped.explain()
    monkeypatch.setattr(sys, "stderr", Impatient())
    stopped = identified(swinging, measured, starts=2, progress=True)
    assert stopped.outcome is nc.Outcome.STOPPED and not stopped.ok and stopped.cost < np.inf
    assert "least cost" in sys.stderr.getvalue()
