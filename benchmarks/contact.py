"""Impacts and rest beside MuJoCo, MJX and Exudyn: a bouncing ball, balls on a floor, derivatives.

usage: python -m benchmarks.contact [--quick] [--output FOLDER] [--no-peers]

A ball of 1 kg falls 1 m on a floor and keeps all of its speed. The second apex should be as high as it began;
`apex error` is what is missing [m], `energy error` what of the energy is made or lost in 3 s, `depth` how far
it goes into the floor [m]. natcoord_jax keeps the gap open by a constraint with an impact law; MuJoCo by a
spring of its constraint solver (solref -k 0), and by its default; Exudyn by a spring. Times are those of
compiled programs (of MuJoCo: of `mj_step` in C) per second of motion, so that steps of all lengths compare.

Balls with friction and restitution on a floor, that bounce or rest: time of a step and ball, in one scene and
in batches, in turn with MuJoCo (one scene, in C) or MJX (lanes, in JAX), which keep none of the speed.

A cloud of balls that collide in free flight, each with a stiffness: time of a step with neighbours that are
looked for, with a gap of every pair (up to 60 balls), and of MuJoCo, whose contact has the same stiffness per
mass and no damping; and what of the energy is made or lost.

The derivative of the height after 1 s of a ball that falls 1 m by the height at the start is exactly 1.2842
for a restitution of 1 (with the speed 0.3 m/s at the start).
"""

from itertools import combinations
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import natcoord_jax as nc
from benchmarks import common, contact_peers

STEPS_OF_BALL = (0.02, 0.01, 0.005, 0.002, 0.001, 0.0005)
SPRINGS = (None, 1e4, 1e6)
"""Stiffness per mass of MuJoCo's contact [1/s^2]; None: its default."""
ENOUGH = 1e-3
"""Error of the second apex [m] at which times are compared."""
EXACT = 1.284175
SIZES = (1, 1), (10, 1), (100, 1), (1, 256), (10, 256), (1, 4096)
"""Balls and lanes."""
CLOUDS = 60, 100, 400
"""Balls of clouds."""
LISTED = 60
"""Balls up to which all pairs are listed, too."""
SOFT = 5e4
"""Stiffness of their contact per mass [1/s^2]."""
COLUMNS = {
    "code": ("code", ""),
    "dt": ("step s", "g"),
    "apex_error": ("apex error m", ".1e"),
    "energy_error": ("energy error", ".1e"),
    "depth": ("depth m", ".1e"),
    "ms_per_second": ("ms/s", ".3g"),
}
COLUMNS_OF_BALLS = {
    "code": ("code", ""),
    "motion": ("motion", ""),
    "balls": ("balls", ""),
    "lanes": ("lanes", ""),
    "us_per_step": ("us/step/ball", ".3g"),
    "over_first": ("over ours", ".2g"),
    "compile_s": ("compile s", ".1f"),
}
COLUMNS_OF_CLOUDS = {
    "code": ("code", ""),
    "balls": ("balls", ""),
    "us_per_step": ("us/step", ".4g"),
    "over_first": ("over ours", ".2g"),
    "energy_error": ("energy error", ".1e"),
    "compile_s": ("compile s", ".1f"),
}


def ball(count: int = 1, **contact: Any) -> tuple[nc.System, nc.State]:
    """Balls side by side, one metre above a floor."""
    scene, floor = nc.Scene(), nc.Plane(normal=(0, 0, 1))
    scene.add(nc.Gravity())
    for k in range(count):
        shape = {"shape": nc.Sphere(0.1), "density": 1 / (4 / 3 * np.pi * 1e-3)}
        one = scene.add(nc.RigidBody(**shape, position=(0.5 * k, 0, 1.1), velocity=(0.3 * (count > 1), 0, 0)))
        scene.add(nc.Contact(one, floor, **contact))
    return scene.compile()


def judged(t: np.ndarray, z: np.ndarray, energy: np.ndarray) -> dict[str, float]:
    """Errors of a run that began one metre above the floor."""
    second = z[(t > 0.46) & (t < 1.34)]
    peak = int(np.argmax(second))
    top = float(second[peak])
    if 0 < peak < len(second) - 1:  # between the states, on the parabola through three of them
        a, b, c = second[peak - 1 : peak + 2]
        top = float(b + (a - c) ** 2 / (8 * (2 * b - a - c)))
    # What a spring holds while it is touched is in no account of these: it is judged in the air.
    drift = np.abs(energy - energy[0])[z > -1e-9].max() / 9.81
    return {"apex_error": abs(top - 1.0), "energy_error": float(drift), "depth": float(max(0.0, -z.min()))}


def ours(dt: float, repeats: int) -> dict[str, Any]:
    """The ball of natcoord_jax."""
    system, state = ball()
    steps = round(3.0 / dt)
    trajectory = nc.simulate(system, state, dt=dt, steps=steps)
    z = np.asarray(trajectory.q)[:, 0, 2] - 0.1
    found = judged(np.asarray(trajectory.t), z, np.asarray(system.energy(trajectory).total))
    run = jax.jit(lambda s: nc.simulate(system, s, dt=dt, steps=steps, save_every=steps).q[-1])
    timing = common.timed(lambda: run(state).block_until_ready(), steps, repeats)
    return {
        "code": "natcoord_jax",
        **common.about(dt, steps),
        **found,
        **timing,
        "ms_per_second": timing["us_per_step"] / dt / 1e3,
    }


def peers_ball(found: tuple[str, Any, dict[str, Any]], dt: float) -> dict[str, Any]:
    """The ball of another code."""
    name, (t, z, energy), timing = found
    return {
        "code": name,
        "dt": dt,
        **judged(t, z, energy),
        **timing,
        "ms_per_second": timing["us_per_step"] / dt / 1e3,
    }


def many(count: int, lanes: int, repeats: int, *, peers: bool) -> list[dict[str, Any]]:
    """Balls that bounce, slide and roll, or rest, each in turn with another code."""
    system, state = ball(count, restitution=0.6, friction=0.3)
    steps, dt = 200, 5e-3

    def run(start: Any, shift: Any) -> Any:
        start = eqx.tree_at(lambda s: s.q, start, start.q.at[::4, 2].add(shift))
        return nc.simulate(system, start, dt=dt, steps=steps, save_every=steps).q[-1]

    program = jax.jit(jax.vmap(run, in_axes=(None, 0)) if lanes > 1 else run)
    lower = eqx.tree_at(lambda s: (s.q, s.v), state, (state.q.at[::4, 2].add(-1.0), jnp.zeros_like(state.v)))
    found = []
    for motion, start in (("bouncing", state), ("resting", lower)):
        resting = motion == "resting"
        shift = jnp.linspace(0.0, 0.0 if resting else 0.2, lanes) if lanes > 1 else jnp.zeros(())
        calls = [lambda start=start, shift=shift: program(start, shift).block_until_ready()]
        names = ["natcoord_jax"]
        if peers and lanes == 1:
            calls.append(contact_peers.mujoco_many(count, dt, steps, resting))
            names.append("MuJoCo")
        elif peers:
            calls.append(contact_peers.mjx_many(count, lanes, dt, steps, resting))
            names.append("MJX")
        timings = common.timed_in_turn(calls, steps * lanes * count, repeats)
        given = {"motion": motion, "balls": count, "lanes": lanes, "dt": dt, "steps": steps}
        of_ours = common.about(dt, steps), {}
        found += [{"code": n, **given, **a, **timing} for n, a, timing in zip(names, of_ours, timings)]
    return found


def cloud(places: np.ndarray, velocities: np.ndarray, *, listed: bool) -> tuple[nc.System, nc.State]:
    """Balls of a kilogram with contact of each with each, by neighbours or by a gap of every pair."""
    scene = nc.Scene()
    shape = {"shape": nc.Sphere(0.1), "density": 1 / (4 / 3 * np.pi * 1e-3)}
    balls = [scene.add(nc.RigidBody(**shape, position=x, velocity=v)) for x, v in zip(places, velocities)]
    if listed:
        for one, other in combinations(balls, 2):
            scene.add(nc.Contact(one, other, stiffness=SOFT))
    else:
        scene.add(nc.Contact(all_pairs_of=balls, stiffness=SOFT, capacity=16))
    return scene.compile()


def clouds(count: int, repeats: int, *, peers: bool) -> list[dict[str, Any]]:
    """A cloud in all the ways there are, in turn."""
    random, edge = np.random.default_rng(1), int(np.ceil(count ** (1 / 3)))
    lattice = np.stack(np.meshgrid(*[np.arange(edge)] * 3), axis=-1).reshape(-1, 3)[:count]
    places = 0.23 * lattice + 0.01 * random.normal(size=(count, 3))
    velocities, dt, steps = random.normal(size=(count, 3)), 1e-3, 200
    names, runs, calls = [], [], []
    for listed in (False, True)[: 1 + (count <= LISTED)]:
        system, state = cloud(places, velocities, listed=listed)
        run = jax.jit(lambda s, n=system: nc.simulate(n, s, dt=dt, steps=steps, save_every=steps).states)
        calls.append(lambda run=run, state=state: jax.block_until_ready(run(state)))
        names.append("natcoord_jax, all pairs" if listed else "natcoord_jax")
        runs.append((system, state, run))
    if peers:
        run, error = contact_peers.mujoco_cloud(places, velocities, dt, steps, SOFT)
        names, calls = [*names, "MuJoCo"], [*calls, run]
    timings = common.timed_in_turn(calls, steps, repeats)
    errors = [_energy_error(*run) for run in runs] + ([error] if peers else [])
    of_ours = common.about(dt, steps)
    return [
        {"code": n, "balls": count, "dt": dt, "steps": steps, "energy_error": e, **timing}
        | (of_ours if n.startswith("natcoord_jax") else {})
        for n, e, timing in zip(names, errors, timings)
    ]


def _energy_error(system: nc.System, state: nc.State, run: Any) -> float:
    """What of the energy a run makes or loses."""
    before, after = (
        float(system.energy(s).total) for s in (state, jax.tree.map(lambda x: x[-1], run(state)))
    )
    return abs(after - before) / before


def derivatives() -> list[dict[str, Any]]:
    """Of the height after one second by that at the start."""
    found = []
    for dt in (0.01, 0.0025):
        for name, contact in (("constraint", {}), ("spring 1e4", {"stiffness": 1e4})):
            system, state = ball(**contact)

            def height(x: Any, system: Any = system, state: Any = state, dt: float = dt) -> Any:
                moved = state.q.at[0, 2].add(x), state.v.at[0, 2].set(0.3)
                start = eqx.tree_at(lambda s: (s.q, s.v), state, moved)
                return nc.simulate(system, start, dt=dt, steps=round(1 / dt)).q[-1, 0, 2]

            found.append({"contact": name, "dt": dt, "slope": float(jax.grad(height)(0.0)), "exact": EXACT})
    return found


def fastest(runs: list[dict[str, Any]], code: str) -> float | None:
    """Time per second of motion of the fastest run that is accurate enough [ms]."""
    enough = [r["ms_per_second"] for r in runs if r["code"].startswith(code) and r["apex_error"] <= ENOUGH]
    return min(enough, default=None)


def main() -> None:
    """Run and print."""
    options = common.peer_parser("Impacts and rest beside MuJoCo.", "nothing").parse_args()
    common.on_one_core()
    quick = options.quick
    jax.config.update("jax_enable_x64", True)
    results = common.circumstances("contact", quick=quick)
    repeats, steps = (2, STEPS_OF_BALL[1:3]) if quick else (5, STEPS_OF_BALL)
    runs = [ours(dt, repeats) for dt in steps]
    peers = not options.no_peers
    if peers:
        given = [(contact_peers.mujoco_ball, k) for k in SPRINGS]
        given += [(contact_peers.exudyn_ball, k) for k in SPRINGS[1:]]
        runs += [peers_ball(make(dt, k, repeats), dt) for make, k in given for dt in steps]
    print(common.columns(runs, COLUMNS))
    sizes = SIZES[:2] if quick else SIZES
    balls = [run for size in sizes for run in many(*size, min(3, repeats), peers=peers)]
    print(common.columns(balls, COLUMNS_OF_BALLS))
    sizes = CLOUDS[:2] if quick else CLOUDS
    flying = [run for count in sizes for run in clouds(count, min(3, repeats), peers=peers)]
    print(common.columns(flying, COLUMNS_OF_CLOUDS))
    slopes = derivatives()
    if peers:
        slope = contact_peers.mjx_slope(0.005)
        slopes.append({"contact": "MJX, default", "dt": 0.005, "slope": slope, "exact": EXACT})
    for line in slopes:
        print(f"slope, {line['contact']}, step {line['dt']:g} s: {line['slope']:.4f} (exact {line['exact']})")
    mine, other = fastest(runs, "natcoord_jax"), fastest(runs, "MuJoCo")
    ratio = None if mine is None or other is None else mine / other
    ten = next((r["compile_s"] for r in balls if r["balls"] == 10 and r["lanes"] == 1), None)
    targets = [
        common.target(f"time over MuJoCo's at an apex error of {ENOUGH:g} m", ratio, 1.0),
        common.target("energy error at any step", max(r["energy_error"] for r in runs[: len(steps)]), 1e-12),
        common.target("compile, ten contacts", ten, 20.0, "s"),
    ]
    results |= {"runs": runs, "balls": balls, "clouds": flying, "derivatives": slopes, "targets": targets}
    print(f"\n{common.environment_line(results)}\n\n{common.show_targets(targets)}")
    common.write(results, None, common.folder(options))


if __name__ == "__main__":
    main()
