"""Callables are seen as they are at each call from Python, and numbers in them compile nothing."""

import functools
import random

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc

GAIN = 1.0
TABLE = np.array([0.0, 0.0, 1.0])
GAINS = dict.fromkeys(("drive", "pull", "law", "module", "force", "tether", "damper", "invariant"), 1.0)


@functools.cache
def motor():
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
    hinge = scene.add(nc.Revolute(nc.ground, body))
    scene.add(nc.JointTorque(hinge))
    return scene.compile()


def run(inputs, **options):
    return nc.simulate(*motor(), dt=0.1, steps=4, inputs=inputs, **options)


def angle(inputs):
    return float(run(inputs).states.coordinates[-1, 0])


def constant(torque):
    """The same with an array, which is seen anyway."""
    return angle(jnp.full((1,), torque))


# --- what a function may read -----------------------------------------------------------------------------


class Controller:
    """An object that can be called."""

    def __init__(self):
        self.gain, self.table, self.settings = 1.0, np.array([0.0, 1.0]), {"gain": 1.0}

    def __call__(self, t, state):
        """The torque."""
        return jnp.array([self.gain])

    def by_table(self, t, state):
        """The torque."""
        return self.table[1:] + 0.0 * t

    def by_setting(self, t, state):
        """The torque."""
        return [self.settings["gain"]]


def by_default(gain=1.0):
    return gain


def readers():
    """A torque that reads numbers in all ways there are, and what changes each of them."""
    controller, cell, names = Controller(), [1.0], {}

    def set_global(value):
        globals()["GAIN"] = value

    def torque(t, state):
        by_name = vars(controller)["gain"] + names.get("more", 0.0)
        tabled = controller.by_table(t, state)[0] * controller.by_setting(t, state)[0]
        return controller(t, state) * by_name * tabled * GAIN * cell[0] * by_default()

    changes = {
        "global": (set_global, 1),
        "cell": (lambda value: cell.__setitem__(0, value), 1),
        "attribute, and by name": (lambda value: setattr(controller, "gain", value), 2),
        "array, in place": (lambda value: controller.table.__setitem__(1, value), 1),
        "dictionary": (lambda value: controller.settings.update(gain=value), 1),
        "default": (lambda value: setattr(by_default, "__defaults__", (value,)), 1),
    }
    return torque, changes


def test_a_changed_number_is_seen(programs):
    """The next call has the new number, and compiles nothing; functions made anew share the program."""
    torque, changes = readers()
    globals()["GAIN"] = 1.0
    expected = {value: constant(value) for value in (0.0, 1.0, 2.0, 4.0)}
    assert angle(torque) == pytest.approx(expected[1.0], abs=1e-13)
    programs.clear()
    for name, (change, power) in changes.items():
        for value in (2.0, 0.0, 1.0):
            change(value)
            assert angle(torque) == pytest.approx(expected[value**power], abs=1e-13), name
    anew, _ = readers()
    assert angle(anew) == pytest.approx(expected[1.0], abs=1e-13)
    assert not programs


def test_functions_made_anew_share_a_program(programs):
    """Lambdas and partial functions of the same formula."""

    def torque(gain, t, state):
        return jnp.array([gain])

    expected = [constant(1.0), constant(3.0)]
    for make in (lambda k: lambda t, s: jnp.array([k]), lambda k: functools.partial(torque, k)):
        answers = [angle(make(1.0))]
        programs.clear()
        answers.append(angle(make(3.0)))
        assert not programs
        assert answers == pytest.approx(expected, abs=1e-13)


@pytest.mark.exhaustive
def test_another_formula_is_seen():
    """What changes the program itself: a switch, an integer, a table of indices."""
    switch, order, picked = [True], [1], np.array([0])

    def torque(t, state):
        value = 2.0 * t if switch[0] else 3.0
        return jnp.array([value * jnp.array([1.0, 4.0])[picked[0]] ** order[0]])

    answers = [angle(torque)]
    for change in (lambda: switch.__setitem__(0, False), lambda: picked.__setitem__(0, 1)):
        change()
        answers.append(angle(torque))
    order[0] = 0
    answers.append(angle(torque))
    expected = [angle(lambda t, s: jnp.array([2.0 * t])), constant(3.0), constant(12.0), constant(3.0)]
    assert answers == pytest.approx(expected, abs=1e-12)


@pytest.mark.exhaustive
def test_a_module_of_numbers_that_reads_a_global(programs):
    """Its numbers stay leaves, and what its methods read is seen."""

    class Policy(eqx.Module):
        gain: jax.Array

        def __call__(self, t, state):
            """The torque."""
            return self.scaled()[None]

        def scaled(self):
            """The gain in units of a global."""
            return GAIN * self.gain

    def end(gain):
        return run(Policy(gain)).states.coordinates[-1, 0]

    globals()["GAIN"] = 1.0
    answers = [end(jnp.array(1.0))]
    slopes = [jax.grad(end)(1.0)]
    programs.clear()
    globals()["GAIN"] = 2.0
    answers.append(end(jnp.array(1.0)))
    assert "jit(_compiled)" not in programs
    slopes.append(jax.grad(end)(1.0))
    assert answers == pytest.approx([constant(1.0), constant(2.0)], abs=1e-13)
    expected = [k * (constant(k + 1e-5) - constant(k - 1e-5)) / 2e-5 for k in (1.0, 2.0)]
    assert slopes == pytest.approx(expected, rel=1e-8)


@pytest.mark.exhaustive
def test_derivatives_through_a_closure():
    """Numbers of a closure, traced or not, under grad, jit and vmap; a changed global is seen in between."""

    def end(k):
        return run(lambda t, s: jnp.array([k * GAIN])).states.coordinates[-1, 0]

    slopes = []
    for value in (1.0, 2.0):
        globals()["GAIN"] = value
        expected = value * (constant(value + 1e-5) - constant(value - 1e-5)) / 2e-5
        slopes.append((jax.grad(end)(1.0), expected))
    slopes.append((jax.jit(jax.grad(end))(1.0), expected))
    lanes = jax.vmap(end)(jnp.array([0.5, 1.0]))
    assert lanes == pytest.approx([constant(1.0), constant(2.0)], abs=1e-13)
    for slope, expected in slopes:
        assert slope == pytest.approx(expected, rel=1e-8)


@pytest.mark.exhaustive
def test_whole_numbers_in_a_closure_under_grad():
    """A table of indices and a flag do not break derivatives."""
    indices, large = jnp.arange(2), jnp.arange(5000)

    def end(k):
        def torque(t, state):
            return (k * jnp.array([1.0, 2.0]))[indices][:1] * (large[3] + 0.0)

        return run(torque).states.coordinates[-1, 0]

    assert end(1.0) == pytest.approx(constant(3.0), abs=1e-13)
    assert jax.grad(end)(1.0) == pytest.approx(3 * (constant(3.00001) - constant(2.99999)) / 2e-5, rel=1e-8)


# --- what is refused --------------------------------------------------------------------------------------


def test_what_cannot_be_seen_is_refused():
    """Chance, a counter, a memory, and a rule for derivatives that JAX does not trace."""
    count = [0.0]

    def counter(t, state):
        count[0] += 1.0
        return jnp.array([count[0]])

    @jax.custom_vjp
    def ruled(t):
        return GAIN * t

    class Integral:
        value = 0.0

        def __call__(self, t, state):
            self.value = self.value + t
            return self.value[None]

    ruled.defvjp(lambda t: (GAIN * t, None), lambda _, dy: (GAIN * dy,))
    with pytest.raises(ValueError, match="not the same.*draws random numbers"):
        run(lambda t, s: jnp.array([random.random()]))
    with pytest.raises(ValueError, match="'counter'.*not the same"):
        run(counter)
    for call in (lambda x: run(Integral()), jax.jit(lambda x: run(Integral()).t + x)):
        with pytest.raises(ValueError, match="a Integral keeps what it has computed.*nc.step"):
            call(0.0)
    with pytest.raises(ValueError, match="use jax.custom_jvp"):
        run(lambda t, s: ruled(t)[None])


@pytest.mark.exhaustive
def test_a_rule_for_derivatives_of_ones_own_is_seen(programs):
    """Of a function with `jax.custom_jvp`; those of JAX's own do not tell functions apart."""

    @jax.custom_jvp
    def ruled(x):
        return x

    ruled.defjvp(lambda x, dx: (x[0], GAIN * dx[0]))

    def end(x):
        policy = lambda t, s: jax.nn.softplus(ruled(x))[None]  # noqa: E731
        return run(policy).states.coordinates[-1, 0]

    globals()["GAIN"] = 1.0
    slope = jax.grad(end)(1.0)
    programs.clear()
    assert jax.grad(end)(1.0) == slope
    assert "jit(_compiled)" not in programs
    globals()["GAIN"] = 3.0
    assert jax.grad(end)(1.0) == pytest.approx(3 * float(slope), rel=1e-12)


# --- where callables are ----------------------------------------------------------------------------------


def test_until(programs):
    """The limit of a terminal event, in a closure and in a global."""
    limit = [0.0]
    states = run(jnp.ones(1)).states

    def passed(state):
        return state.coordinates[0] - limit[0]

    for k in (1, 3, 2):
        limit[0] = float(states.coordinates[k, 0]) - 1e-6
        programs.clear()
        assert int(run(jnp.ones(1), until=passed).failed_step) == k
        assert k == 1 or not programs


@pytest.mark.exhaustive
def test_equilibria(programs):
    """A load whose size is a global."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
    hinge = scene.add(nc.Revolute(nc.ground, body))
    scene.add(nc.JointSpring(hinge, stiffness=10.0))
    scene.add(nc.BodyTorque((nc.Direction(body, (1, 0, 0)),), torque=lambda t: jnp.array([0, 0, GAIN]) * t))
    system, state = scene.compile()
    for value in (1.0, 2.0):
        globals()["GAIN"] = value
        balanced = nc.equilibrium(system, state)
        assert system.coordinate(balanced.state, hinge) == pytest.approx(value / 10.0, abs=1e-9)
        assert value == 1.0 or not programs
        programs.clear()


class Pull(nc.Force):
    """A force that reads a global and an array."""

    size: float = 1.0

    def load(self, x, rate, inputs, t):
        """Along the table."""
        return nc.Load(jnp.zeros_like(x).at[0].set(GAINS["force"] * self.size * TABLE * (1.0 + t)), None)


class Tether(nc.Potential):
    """A spring that reads a global."""

    stiffness: float = 1.0

    def invariants(self, x):
        """The squared distance."""
        return GAINS["invariant"] * ((x[1] - x[0]) @ (x[1] - x[0]))[None]

    def energy(self, invariants):
        """Of the square of the squared distance."""
        return 0.5 * GAINS["tether"] * self.stiffness * invariants[0] ** 2


class Brake(nc.JointDamper):
    """A damper that scales that of the library."""

    def force(self, rate, inputs, t):
        """In units of a global."""
        return GAINS["damper"] * super().force(rate, inputs, t)


class Law(eqx.Module):
    """An energy with a number of its own."""

    stiffness: jax.Array

    def __call__(self, c):
        """Quadratic."""
        return 0.5 * GAINS["module"] * self.stiffness * c**2


@pytest.mark.exhaustive
def test_effects(programs):
    """Functions and methods in every kind of effect, among them two instances that share a program."""
    scene = nc.Scene()
    arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.2, 1.3), com=(0.5, 0.0, 0.0), name="arm"))
    ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.2, 1.3), position=(0, 1, 0), name="ball"))
    hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 0, 1)))
    slide = scene.add(nc.Prismatic(nc.ground, ball, axis=(0, 0, 1)))
    driven = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.2, 1.3), position=(0, 2, 0), name="driven"))
    wheel = scene.add(nc.Revolute(nc.ground, driven, axis=(1, 0, 0)))
    tip = nc.Point(arm, (1.0, 0.0, 0.0))
    scene.add(nc.Drive(wheel, function=lambda t: 0.3 * GAINS["drive"] * t**2))
    scene.add(nc.PointForce((tip,), force=lambda t: [0.0, GAINS["pull"], 0.0]))
    scene.add(nc.JointPotential(hinge, law=lambda c: 0.5 * GAINS["law"] * (c - 0.2) ** 2, name="law"))
    scene.add(nc.JointPotential(slide, law=Law(jnp.array(2.0)), name="module"))
    for place in ((0.0, 1.0, 0.0), (0.1, 1.0, 0.0)):
        scene.add(Pull((nc.Point(ball, place),)))
    scene.add(Tether((nc.Point(nc.ground, (0, 1, -1)), nc.Point(ball, (0, 1, 0))), name="tether"))
    scene.add(Brake(hinge, damping=0.5))
    system, state = scene.compile()

    def everything():
        run = nc.simulate(system, state, dt=0.1, steps=5)
        return np.asarray(run.q[-1]), np.asarray(system.energy(run).total)

    GAINS.update(dict.fromkeys(GAINS, 1.0))
    base = everything()
    programs.clear()
    for name in GAINS:
        GAINS[name] = 1.5
        changed = everything()
        assert np.abs(changed[0] - base[0]).max() > 1e-5, f"{name} was not seen"
        GAINS[name] = 1.0
        assert all(np.array_equal(a, b) for a, b in zip(everything(), base, strict=True))
    assert not programs
    GAINS.update(dict.fromkeys(GAINS, 1.5))
    TABLE[2] = 2.0
    seen, anew = everything(), jax.jit(lambda s: nc.simulate(system, s, dt=0.1, steps=5).q[-1])(state)
    TABLE[2] = 1.0
    GAINS.update(dict.fromkeys(GAINS, 1.0))
    assert np.abs(seen[0] - anew).max() < 1e-12
    assert np.abs(np.diff(seen[1])).max() > 0


@pytest.mark.exhaustive
def test_costs_goals_and_bounds(programs):
    """Functions and methods in an optimal control problem; a place in the system that a function chooses."""
    system, state = motor()

    class Effort(nc.cost.Cost):
        """An effort in units of a global."""

        def running(self, system, state, u, t):
            """Weighted sum of squares."""
            return GAIN * jnp.sum(u**2)

    place = [0]

    def problem(target):
        return nc.OptimalControl(
            system,
            state,
            dt=0.1,
            steps=5,
            cost=Effort() + nc.cost.Running(lambda s, u, t: 0.1 * GAIN * s.coordinates[0] ** 2),
            goal=nc.goal.Equal(lambda s: s.coordinates[0] - target[0]),
        )

    def solved(target):
        solution = nc.optimise(problem(target), progress=False)
        assert solution.ok
        return float(solution.cost), float(solution.trajectory.states.coordinates[-1, 0])

    globals()["GAIN"] = 1.0
    target = [0.2]
    first = solved(target)
    programs.clear()
    globals()["GAIN"] = 3.0
    second = solved(target)
    target[0] = 0.4
    third = solved(target)
    assert not [name for name in programs if name not in ("jit(_compiled)",)]
    assert second[0] == pytest.approx(3 * first[0], rel=1e-6)
    assert [x[1] for x in (first, second, third)] == pytest.approx([0.2, 0.2, 0.4], abs=1e-8)
    parameter = nc.Parameter("mass", where=lambda s: (s.mass, s.frames)[place[0]], index=(0, 0, 0))
    assert float(parameter.initial(system)) == 1.0
    assert parameter.applied(system, jnp.array(2.0)).mass[0, 0, 0] == 2.0
    with pytest.raises(ValueError, match="which is no leaf"):
        nc.Parameter("a", where=lambda s: s.tree).initial(system)
