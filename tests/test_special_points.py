"""Laws, norms and quotients where they are singular or out of range: value and two derivatives.

At lengths of zero, at rest, at stops, where a law decays to 1e-260, derivatives must be right or be said to
be none. All is judged by differences, which know nothing of branches. What has one structure is one program,
its numbers are lanes.
"""

import warnings
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import STEPS

import natcoord_jax as nc
from natcoord_jax.control import costates
from natcoord_jax.maths.rotations import from_rotation_vector
from natcoord_jax.maths.vectors import largest, quotient, safe_divide, safe_norm, unit

ENDS = nc.Point(nc.ground), nc.Point(nc.ground, (0.0, 0.0, 1.0))


def least_miss(f, x, direction, exact):
    """Of differences of all steps; not a number where one of them is none."""

    def miss(step):
        ahead, behind = f(x + step * direction), f(x - step * direction)
        return jnp.max(jnp.abs((ahead - behind) / (2 * step) - exact))

    return jnp.min(jax.vmap(miss)(jnp.asarray(STEPS)))


def derivatives_judged(f, second):
    """Of a point and a direction: misses of reverse, of the first and the second derivative, and a size."""

    def judged(x, direction):
        slope, ahead = jax.grad(f), jax.jvp(f, (x,), (direction,))[1]
        reverse = jnp.abs(jnp.vdot(slope(x), direction) - ahead)
        first, size = least_miss(f, x, direction, ahead), jnp.abs(ahead)
        if not second:
            return reverse, first, jnp.zeros(()), size
        bent = jax.jvp(slope, (x,), (direction,))[1]
        first, size = jnp.where(ahead == 0, 0.0, first), size + jnp.max(jnp.abs(bent))
        return reverse, first, least_miss(slope, x, direction, bent), size

    return judged


def assert_derivatives(f, points, directions, name, second=True):
    """Gradient and second derivatives of a scalar function, in every mode, at points along directions."""
    lanes = jax.vmap(jax.vmap(derivatives_judged(f, second), (None, 0)), (0, None))
    reverse, first, bent, size = jax.jit(lanes)(points, directions)
    for what, misses, bound in (
        ("forward and reverse", reverse, tol.SAME_GRADIENT),
        ("first derivative", first, tol.DIFFERENCE_BEST),
        ("second derivative", bent, tol.DIFFERENCE_BEST),
    ):
        assert np.all(misses <= bound * size), (name, what, misses, size)


# --- vectors ----------------------------------------------------------------------------------------------

SIZES = (1e-300, 1e-200, 1e-160, 1.0, 1e150, 1e200)


def test_norms_units_and_quotients_neither_underflow_nor_overflow():
    """And quotients do not square what they divide by: two derivatives, forward over reverse and reversed."""

    @jax.jit
    @jax.vmap
    def answers(size):
        a, along = size * jnp.array([3.0, 4.0, 12.0]), jnp.array([1.0, 0.0, 0.0])

        def share(s):
            return quotient(size, 2.0 * size * s)

        def pushed(s):
            return jax.jvp(share, (s,), (1.0,))[1]

        slope = jax.grad(share)
        return {
            "norm": safe_norm(a) / size,
            "slope of the norm": jax.grad(safe_norm)(a),
            "unit": unit(a),
            "turning": jax.jvp(unit, (a,), (size * along,))[1],
            "quotient": jnp.array([share(1.0), slope(1.0), jax.jvp(slope, (1.0,), (1.0,))[1]]),
            "in the other order": jax.grad(pushed)(1.0),
        }

    axis = np.array([3.0, 4.0, 12.0]) / 13.0
    expected = {
        "norm": 13.0,
        "slope of the norm": axis,
        "unit": axis,
        "turning": (np.array([1.0, 0.0, 0.0]) - axis[0] * axis) / 13.0,
        "quotient": (0.5, -0.5, 1.0),
        "in the other order": 1.0,
    }
    for name, values in answers(jnp.array(SIZES)).items():
        for size, value in zip(SIZES, values, strict=True):
            np.testing.assert_allclose(
                value, expected[name], rtol=tol.IDENTITY, atol=1e-15, err_msg=f"{name} {size}"
            )


def test_nothing_has_a_norm_and_a_quotient_with_slopes_of_zero():
    nothing = jnp.zeros(3)
    assert float(safe_norm(nothing)) == 0.0 and not np.any(jax.grad(safe_norm)(nothing))
    assert float(safe_divide(1.0, 0.0)) == 0.0
    assert [float(x) for x in jax.grad(safe_divide, (0, 1))(1.0, 0.0)] == [0.0, 0.0]


def test_rotations_are_smooth_in_their_vector():
    """Three derivatives at zero and on each side of where the series ends."""
    direction = jnp.array([0.3, -0.8, 0.5])

    @jax.jit
    @jax.vmap
    def misses(angle):
        vector, judged = angle / 3.0 * jnp.array([1.0, 2.0, 2.0]), []
        f = lambda s: from_rotation_vector(vector + s * direction)  # noqa: E731
        for _ in range(3):
            before, f = f, jax.jacfwd(f)
            exact = f(0.0)
            judged.append(least_miss(before, 0.0, 1.0, exact) / jnp.max(jnp.abs(exact)))
        return jnp.array(judged)

    angles = np.array([0.0, 1e-9, 1e-3, 0.0316, 0.0317, 1.0, np.pi])
    assert np.all(misses(angles) <= tol.DIFFERENCE_BEST)


def test_the_largest_number_has_the_slope_of_one_that_is_it():
    """Where equal ones are computed twice, too: however programs round, there is one that is chosen."""
    for count in (1, 2, 7):
        x = jnp.asarray(np.random.default_rng(count).normal(size=(count, 5)))
        np.testing.assert_array_equal(largest(x), jnp.max(x, axis=0))
        chosen = jax.grad(lambda x: jnp.sum(largest(x)))(x)
        np.testing.assert_array_equal(chosen, x == jnp.max(x, axis=0))
    for values in ((1.0, 1.0, 1.0), (2.0, -1.0, 2.0), (0.0, 0.0)):
        chosen = jax.grad(largest)(jnp.array(values))
        assert sorted(chosen.tolist())[-1] == 1.0 and float(jnp.sum(chosen)) == 1.0


# --- springs between points -------------------------------------------------------------------------------

EVEN_LAWS = {
    "linear": lambda d: 1.5 * d**2,
    "hardening": lambda d: jnp.cosh(3.0 * d),
    "softening": lambda d: 1.0 - jnp.cos(d),
    "quartic": lambda d: 2.0 * d**2 + d**4,
}
DISTANCES = np.array([0.0, 1e-17, 9e-13, 1e-9, 1e-3, 0.7])


def energy_of(law):
    """Of a spring with a law, over the vector between its ends."""
    return lambda u: nc.NonlinearSpring(ENDS, law=law).energy(jnp.sum(u * u)[None])


@pytest.mark.parametrize(
    "name",
    ["hardening", *(pytest.param(x, marks=pytest.mark.exhaustive) for x in EVEN_LAWS if x != "hardening")],
)
def test_even_laws_are_smooth_where_points_coincide(name):
    """Against the same law of three components, which has no root: along and across the connecting line."""
    law, line = EVEN_LAWS[name], np.array([0.6, 0.0, 0.8])
    energy, away = energy_of(law), jnp.asarray(DISTANCES[:, None] * line)
    assert_derivatives(energy, away, jnp.array([line, [0.0, 1.0, 0.0]]), name)
    stiffness = jax.vmap(jax.hessian(law))(jnp.asarray(DISTANCES))
    slopes = jax.vmap(jax.grad(law))(jnp.asarray(DISTANCES))
    curvatures = np.linalg.eigvalsh(jax.jit(jax.vmap(jax.hessian(energy)))(away))
    for distance, along, slope, values in zip(DISTANCES, stiffness, slopes, curvatures, strict=True):
        across = slope / distance if distance > 1e-6 else stiffness[0]
        assert np.allclose(values, np.sort([along, across, across]), rtol=tol.EXACT_GRADIENT), distance


def test_derivatives_by_the_length_of_a_spring():
    """The unstretched length is a number like all numbers: zero is not another program."""

    def energy(length, square):
        return nc.Spring(ENDS, stiffness=5.0, length=length).energy(jnp.asarray(square)[None])

    @jax.jit
    @jax.vmap
    def answers(length):
        slope = jax.grad(energy, argnums=1)
        by_length = jax.grad(energy)(length, 0.49)
        at_zero = energy(length, 0.0)
        return by_length, slope(length, 0.49), slope(length, 0.0), at_zero, energy(length, -1e-9) - at_zero

    lengths = np.array([0.0, 0.3])
    expected = (-5.0 * (0.7 - lengths), 2.5 * (1 - lengths / 0.7), 2.5 + 0 * lengths, 2.5 * lengths**2)
    *values, beyond = answers(lengths)
    for value, exact in zip(values, expected, strict=True):
        np.testing.assert_allclose(value, exact, rtol=tol.INDIFFERENCE, atol=tol.IDENTITY)
    np.testing.assert_allclose(beyond, -2.5e-9, atol=1e-15)


def test_laws_without_second_derivative_at_zero_keep_their_force():
    """Hertz' law: continuous force, infinite stiffness; what is made of it must not be larger than that."""
    distances = np.array([0.0, 1e-16, 1e-13])
    pull = jax.vmap(jax.grad(lambda x: energy_of(lambda d: d**1.5)(x[None])))(jnp.asarray(distances))
    assert np.all(pull >= 0.0) and np.all(pull <= 1.5 * distances**0.5)


# --- stops -------------------------------------------------------------------------------------------------


def test_stops_on_each_side_and_at_the_stop():
    """At the stop derivatives are those before contact."""
    scene = nc.Scene()
    joint = scene.add(nc.Prismatic(nc.ground, scene.add(nc.PointMass(mass=1.0)), name="joint"))

    def answers(stops, coordinates):
        functions = stops.energy, jax.grad(stops.energy), jax.hessian(stops.energy)
        return np.array([jax.vmap(f)(jnp.asarray(coordinates)) for f in functions])

    coordinates = np.array([-0.3, -1e-9, 1e-9, 0.4])
    stops = nc.JointStops(joint, lower=-jnp.inf, upper=0.0, stiffness=9.0)
    beyond = np.maximum(coordinates, 0.0)
    expected = 4.5 * beyond**2, 9.0 * beyond, 9.0 * (coordinates > 0)
    np.testing.assert_allclose(answers(stops, coordinates), expected, rtol=tol.IDENTITY, atol=1e-300)
    for side in ({"upper": 0.2}, {"lower": 0.2}):
        assert not np.any(answers(nc.JointStops(joint, stiffness=9.0, **side), np.array([0.2])))


# --- rollouts ---------------------------------------------------------------------------------------------


def slide_and_mount():
    """A slide before a soft stop, and a point mass on mounts of no length, one of them hardening.

    At 0.3 m from the stop its energy is 1e-260 J; the mass is at rest in the mounts, or beside.
    """
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
    joint = scene.add(nc.Prismatic(nc.ground, body, axis=(1, 0, 0)))
    scene.add(nc.JointPotential(joint, law=lambda c: 5e3 * (1e-3 * jax.nn.softplus(c / 1e-3)) ** 2))
    scene.add(nc.JointDamper(joint, damping=0.5))
    ball = scene.add(nc.PointMass(mass=2.0))
    ends = nc.Point(nc.ground), nc.Point(ball)
    scene.add(nc.Spring(ends, stiffness=50.0))
    scene.add(nc.NonlinearSpring(ends, law=lambda d: 25.0 * d**2 + 40.0 * d**4))
    system, state = scene.compile()
    row = 4 * system.body_index(ball.name)
    slide = 4 * system.body_index(body.name)

    def start(x):
        moved = system.with_coordinate(state, joint, x[0], rate=x[1])
        q, v = moved.q.at[row, 0].add(x[2]), moved.v.at[row, 2].add(x[3])
        return eqx.tree_at(lambda s: (s.q, s.v), moved, (q, v))

    def end(x, scheme):
        run = nc.simulate(system, start(x), dt=0.01, steps=3, scheme=scheme, throw=False)
        on_slide = 10.0 * run.q[-1, slide, 0] + run.v[-1, slide, 0]
        return on_slide + 10.0 * run.q[-1, row, 0] + run.v[-1, row, 2]

    return end


POINTS = np.array(
    [
        (-0.3, 0.0, 0.0, 0.0),
        (-0.3, 1.0, 0.0, 0.5),
        (-0.008, 1.0, 1e-9, 0.0),
        (-0.008, 1.0, 0.2, 0.5),
    ]
)
DIRECTIONS = np.array([(0.6, 0.8, 0.0, 0.0), (0.0, 0.0, 0.6, 0.8)])


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("order", "second"),
    [(2, False), (2, True), (4, True)],
)
def test_rollouts_from_special_points(order, second):
    """Reverse, forward and second derivatives of a few steps, along the slide and along the mount."""
    end = partial(slide_and_mount(), scheme=nc.EnergyMomentum(order=order))
    assert_derivatives(end, jnp.asarray(POINTS), jnp.asarray(DIRECTIONS), order, second)


# --- what depends on second derivatives --------------------------------------------------------------------


@pytest.mark.exhaustive
def test_modes_of_a_body_on_springs_of_no_length():
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=2.0, inertia=(0.1, 0.2, 0.3)))
    for place in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)):
        scene.add(nc.Spring((nc.Point(nc.ground, place), nc.Point(body, place)), stiffness=50.0))
    frequencies = np.sort(nc.modes(*scene.compile()).frequencies)
    turning = np.sqrt([100.0 / 0.1, 100.0 / 0.2, 200.0 / 0.3])
    assert np.allclose(frequencies, np.sort([10.0, 10.0, 10.0, *turning]), rtol=tol.EXACT_GRADIENT)


@pytest.mark.exhaustive
def test_modes_of_a_point_mass_between_springs():
    """Along sqrt(2 k / m), across sqrt(2 k / m (1 - L / d)); its directors do not turn, and are no modes."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, position=(1, 0, 0)))
    for end in ((0, 0, 0), (2, 0, 0)):
        scene.add(nc.Spring((nc.Point(nc.ground, end), nc.Point(ball, (1, 0, 0))), stiffness=3.0, length=0.5))
    system, state = scene.compile()
    for damped in (False, True):
        modes = nc.modes(system, state, damped=damped)
        assert np.allclose(modes.frequencies, np.sqrt([3.0, 3.0, 6.0]), rtol=tol.INDIFFERENCE)
        assert not np.any(modes.shapes[:, 1:])
    scene.add(nc.Gravity())
    system, state = scene.compile()
    sagged = nc.equilibrium(system, state).state
    depth = -float(sagged.q[0, 2])
    length = np.hypot(1.0, depth)
    assert 6.0 * (length - 0.5) * depth / length == pytest.approx(9.81, rel=tol.EXACT_GRADIENT)
    squares = np.sort(nc.modes(system, sagged).frequencies ** 2)
    sideways = 6.0 * (1 - 0.5 / length)
    along = 6.0 * (1 - 0.5 / length + 0.5 * np.array([1.0, depth**2]) / length**3)
    assert np.allclose(squares, np.sort([sideways, *along]), rtol=tol.EXACT_GRADIENT)


@pytest.mark.exhaustive
def test_modes_of_a_point_mass_on_a_joint():
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -10.0)))
    ball = scene.add(nc.PointMass(mass=1.0, position=(0, 0, -2.0)))
    scene.add(nc.Distance(nc.ground, ball, point=(0, 0, -2.0)))
    assert np.allclose(nc.modes(*scene.compile()).frequencies, np.sqrt([5.0, 5.0]), rtol=tol.EXACT_GRADIENT)


# --- what is singular is said to be ------------------------------------------------------------------------


def test_a_rod_without_length_is_refused():
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0))
    scene.add(nc.Distance(nc.ground, ball, point=(0, 0, 0), name="rod"))
    with pytest.raises(ValueError, match=r"'rod': length \[m\] is 0"):
        scene.compile()


def circle(arc):
    return jnp.stack([jnp.cos(arc), jnp.sin(arc), 0.0 * arc])


@pytest.mark.parametrize(
    ("curve", "length", "elements", "part"),
    [
        (circle, 2 * np.pi, 1, "element 0"),
        (circle, 2 * np.pi, 2, "turns back"),
        ([(0, 0, 0), (1, 0, 0), (0, 0, 0)], None, 4, "turns back"),
    ],
)
def test_beams_that_turn_too_far_between_nodes_are_refused(curve, length, elements, part):
    section = nc.CircularSection(radius=0.01, E=1e7, density=1000.0)
    with pytest.raises(ValueError, match=f"beam 'ring'.*{part}"):
        nc.Scene().add(nc.Beam(section, curve, length=length, elements=elements, name="ring"))


def test_half_a_turn_of_an_element_has_no_strain():
    """It is not a number, where it was none before: silently."""
    ends = [nc.Attachment(nc.ground, (0, 0, z), np.eye(3)) for z in (0.0, 1.0)]
    element = nc.BeamElement(ends, length=1.0, stiffness=np.eye(6))
    place = jnp.array([0.0, 0.0, 1.0])
    assert np.all(np.isnan(element.strains(jnp.concatenate([jnp.zeros(3), -jnp.ones(1), place]))[3:]))
    nearly = jnp.array([2 * np.sin(3.1), 0.0, 0.0, 1 + 2 * np.cos(3.1), *place])
    assert float(element.strains(nearly)[3]) == pytest.approx(3.1, rel=tol.INDIFFERENCE)


@pytest.mark.parametrize("n", [1, 2, 10])
def test_lumped_inertia_of_a_beam_is_what_its_docstring_says(n):
    section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=1.0, GJ=1.0, density=3.0, rotary=0.0)
    for point, factor in ((0.0, (1 + 1 / (2 * n**2)) / 3), (-0.5, (1 + 2 / n**2) / 12)):
        scene = nc.Scene()
        beam = scene.add(nc.Beam(section, [(2 * point, 0, 0), (2 * point + 2, 0, 0)], elements=n))
        masses = [scene.bodies[h.name].mass_block[0, 0] for h in beam.nodes]
        places = [scene.bodies[h.name].position[0] for h in beam.nodes]
        inertia = sum(m * x**2 for m, x in zip(masses, places, strict=True))
        assert float(inertia) == pytest.approx(6.0 * 4.0 * factor, rel=tol.INDIFFERENCE)


@pytest.mark.exhaustive
def test_a_rotor_that_turns_too_far_in_a_step_is_told():
    """At 2.5 rad a step the rate shows 250 rad/s beside an angle that says 179; with the step that is advised
    both are the same to a percent, and nothing is said."""
    scene = nc.Scene()
    rotor = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
    hinge = scene.add(nc.Revolute(nc.ground, rotor, name="hinge"))
    system, state = scene.compile()
    spinning = system.with_coordinate(state, hinge, 0.0, rate=250.0)
    with pytest.warns(UserWarning, match=r"'hinge' turns by 1\.79 rad in a step of 0\.01 s.*dt = 0\.0014 s"):
        nc.simulate(system, spinning, dt=0.01, steps=4)
    with pytest.warns(UserWarning, match=r"'hinge' turns by 1\.79 rad"):
        nc.simulate(system, spinning, dt=0.01, steps=4, save_every=2)
    scene.add(nc.Drive(hinge, function=lambda t: 40.0 * t, name="drive"))
    driven = scene.compile(assemble=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # What a drive turns by more than half a turn has the angle and the rate that are asked for.
        nc.simulate(*driven, dt=0.1, steps=4)
        run = nc.simulate(system, spinning, dt=0.0014, steps=4)
        jax.jit(lambda s: nc.simulate(system, s, dt=0.01, steps=4).q)(spinning)
    assert float(run.states.coordinates[-1, 0] / run.t[-1]) == pytest.approx(250.0, rel=0.0105)


# --- derivatives that are none ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def turntable():
    """A disc on a hinge with a motor."""
    scene = nc.Scene()
    disc = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0)))
    hinge = scene.add(nc.Revolute(nc.ground, disc, name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


MODES = {
    "grad": lambda f, x: jax.grad(f)(x),
    "jvp": lambda f, x: jax.jvp(f, (x,), (jnp.ones_like(x),))[1],
    "jacrev": lambda f, x: jax.jacrev(f)(x),
    "jacfwd": lambda f, x: jax.jacfwd(f)(x),
    "hessian": lambda f, x: jax.hessian(f)(x),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", MODES)
def test_a_derivative_that_is_none_is_an_error_in_python_and_nan_in_jit(turntable, mode):
    system, state = turntable

    def end(u, law):
        options = dict(dt=0.1, steps=5, inputs=lambda t, s: u * law(s.coordinates[:1]))
        return nc.simulate(system, state, **options).states.coordinates[-1, 0]

    rough, u = partial(end, law=lambda x: jnp.sqrt(jnp.abs(x))), jnp.array([0.5])
    with pytest.raises(nc.DerivativeError, match="simulate: a derivative is not a number"):
        MODES[mode](rough, u)
    assert np.all(np.isnan(nc.jit(partial(MODES[mode], rough))(u)))
    assert np.all(np.isfinite(MODES[mode](partial(end, law=jnp.cos), u)))


@pytest.mark.exhaustive
def test_what_is_no_number_before_is_no_fault_of_a_run(turntable):
    system, state = turntable

    def end(u):
        return nc.simulate(system, state, dt=0.1, steps=5, inputs=jnp.sqrt(u)).states.coordinates[-1, 0]

    assert np.isinf(jax.grad(end)(jnp.zeros(1))[0])
    assert np.isnan(jax.grad(lambda u: jnp.sqrt(end(u)) * 0.0)(jnp.zeros(1))[0])


@pytest.mark.exhaustive
def test_control_says_that_a_step_has_no_derivative(turntable, monkeypatch):
    system, state = turntable
    problem = nc.OptimalControl(
        system, state, dt=0.1, steps=7, cost=nc.cost.Effort(), goal=nc.goal.Coordinate("hinge", 1.0)
    )
    monkeypatch.setattr(costates, "UNSOLVED", -1.0)
    for method in ("shooting", "lifted", "auto"):
        solution = nc.optimise(problem, method=method, progress=False)
        assert solution.outcome is nc.Outcome.SINGULAR
        assert "linearised equations have no solution" in solution.explain()


@pytest.mark.exhaustive
def test_descent_ends_where_there_is_no_slope(turntable):
    system, state = turntable
    rough = nc.cost.Terminal(lambda state: jnp.sqrt(jnp.abs(state.coordinates[0])))
    problem = nc.OptimalControl(system, state, dt=0.1, steps=5, cost=rough)
    solution = nc.descend(problem, iterations=3, progress=False)
    assert solution.outcome is nc.Outcome.NONFINITE
    assert np.all(np.isfinite(solution.inputs))


@pytest.mark.exhaustive
def test_known_tangents_and_unknown_ones_pass_side_by_side(turntable):
    """The gradient of a directional derivative along a direction that is fixed, several of them at once."""
    system, state = turntable

    def end(u, dt):
        return nc.simulate(system, state, dt=dt, inputs=u).states.coordinates[-1, 0]

    def along(u, direction):
        return jax.jvp(partial(end, u), (0.1,), (direction,))[1]

    u, directions = jnp.ones((5, 1)), jnp.array([1.0, 2.0])
    slopes = jax.vmap(jax.grad(along), (None, 0))(u, directions)
    slope = jax.grad(lambda u: jax.grad(end, 1)(u, 0.1))(u)
    np.testing.assert_allclose(slopes, directions[:, None, None] * slope, rtol=tol.SAME_GRADIENT)
