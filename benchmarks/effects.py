"""What each effect adds to a scene that calls for it: time a step, unknowns, program, compilation.

usage: python -m benchmarks.effects [--quick] [--output FOLDER] [--redraw JSON]

The base scene is an arm of two bodies on two hinges, released from rest under gravity; gravity is taken away
to measure it. Every other line adds one effect, or one body with the joint, a third body that closes a
four-bar (two hinges, planar: redundant), or a beam of four elements. Each is timed in turn with the base,
round by round: `over_first` is the time a step over that of the base in the same round. `program` counts the
lines of the lowered program. What is not in a scene is in none of its numbers.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import natcoord_jax as nc
from benchmarks import common, compiled

DT = 0.005
STEPS = 400

Addition = Callable[[nc.Scene, list[Any], list[Any]], Any]


def _points(bodies: list[Any]) -> tuple[Any, Any]:
    return nc.Point(bodies[0], (0.5, 0, 0.2)), nc.Point(bodies[1], (1.6, 0, 0.1))


def _body(scene: nc.Scene, **options: Any) -> Any:
    return scene.add(nc.RigidBody(mass=0.8, inertia=(0.02, 0.05, 0.06), position=(2.3, 0.1, 0), **options))


def _joined(kind: type, **options: Any) -> Addition:
    def add(scene: nc.Scene, bodies: list[Any], hinges: list[Any]) -> None:
        point = {} if kind is nc.Distance else {"point": (2.0, 0, 0)}
        if kind is nc.Distance:
            point = {"point": (2.1, 0.1, 0), "parent_point": (1.8, 0, 0)}
        if kind not in (nc.Spherical, nc.Fixed, nc.Distance):
            point["axis"] = (0, 0, 1)
        scene.add(kind(bodies[1], _body(scene), **point, **options))

    return add


def _directions(body: Any) -> tuple[Any, ...]:
    return tuple(nc.Direction(body, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1)))


def _closed(scene: nc.Scene, bodies: list[Any], hinges: list[Any]) -> None:
    rocker = scene.add(nc.RigidBody(mass=1.0, inertia=(0.09, 0.09, 0.01), position=(2.0, 0, -0.5)))
    for name, parent, height in (("coupler", bodies[1], 0.0), ("foot", nc.ground, -1.0)):
        scene.add(nc.Revolute(parent, rocker, point=(2.0, 0, height), axis=(0, 1, 0), name=name))


def _beam(scene: nc.Scene, bodies: list[Any], hinges: list[Any]) -> None:
    section = nc.Section.of_numbers(EA=1e4, GA=5e3, EI=2.0, GJ=1.5, density=1.0, rotary=1e-3)
    scene.add(nc.Beam(section, [(2, 0, 0), (3, 0, 0)], elements=4, start=bodies[1]))


EFFECTS: dict[str, Addition] = {
    "spring": lambda s, b, h: s.add(nc.Spring(_points(b), stiffness=20.0, length=0.8)),
    "nonlinear spring": lambda s, b, h: s.add(
        nc.NonlinearSpring(_points(b), law=lambda x: 10.0 * x**2 + 2.0 * x**4)
    ),
    "damper": lambda s, b, h: s.add(nc.Damper(_points(b), damping=0.5)),
    "joint spring": lambda s, b, h: s.add(nc.JointSpring(h[1], stiffness=2.0)),
    "joint damper": lambda s, b, h: s.add(nc.JointDamper(h[1], damping=0.1)),
    "armature": lambda s, b, h: s.add(nc.Armature(h[1], inertia=0.1)),
    "motor (an input)": lambda s, b, h: s.add(nc.JointTorque(h[1], name="motor")),
    "force at a point": lambda s, b, h: s.add(nc.PointForce(_points(b)[1:], force=(0.0, 0.5, 1.0))),
    "following torque": lambda s, b, h: s.add(
        nc.BodyTorque(_directions(b[1]), torque=(0.0, 0.5, 0.1), following=True)
    ),
    "thruster (an input)": lambda s, b, h: s.add(
        nc.BodyForceInput((_points(b)[1], nc.Direction(b[1], (0, 0, 1))), name="thruster")
    ),
    "body torque (three inputs)": lambda s, b, h: s.add(nc.BodyTorqueInput(_directions(b[1]), name="torque")),
    "joint stops": lambda s, b, h: s.add(nc.JointStops(h[1], lower=-0.5, upper=0.5, stiffness=50.0)),
    "drive": lambda s, b, h: s.add(nc.Drive(h[1], function=lambda t: 0.3 * (1 - jnp.cos(2 * t)))),
    "coupling": lambda s, b, h: s.add(nc.Coupling((h[0], h[1]), factors=(1.0, -2.0), coordinate=(0, 0))),
    "free body": lambda s, b, h: _body(s),
    "revolute": _joined(nc.Revolute),
    "spherical": _joined(nc.Spherical),
    "universal": _joined(nc.Universal, second=(0, 1, 0)),
    "prismatic": _joined(nc.Prismatic),
    "cylindrical": _joined(nc.Cylindrical),
    "planar": _joined(nc.Planar),
    "fixed": _joined(nc.Fixed),
    "screw": _joined(nc.Screw, pitch=0.1),
    "distance": _joined(nc.Distance),
    "loop: a rocker on two hinges": _closed,
    "beam, four elements": _beam,
}


def build(add: Addition | None, *, gravity: bool = True) -> tuple[nc.System, nc.State]:
    """The base scene with one addition."""
    scene = nc.Scene()
    if gravity:
        scene.add(nc.Gravity())
    bodies: list[Any] = []
    hinges: list[Any] = []
    for k in range(2):
        arm = scene.add(
            nc.RigidBody(mass=1.0, inertia=(0.01, 0.09, 0.09), position=(k + 0.5, 0, 0), name=f"arm {k}")
        )
        below = bodies[-1] if bodies else nc.ground
        hinges.append(scene.add(nc.Revolute(below, arm, point=(k, 0, 0), axis=(0, 1, 0))))
        bodies.append(arm)
    if add is not None:
        add(scene, bodies, hinges)
    return scene.compile()


def _rollout(system: nc.System, state: nc.State, steps: int) -> compiled.Rollout:
    return compiled.Rollout(system, state, jnp.full((steps, len(system.structure.inputs)), 0.1), DT)


def measure(
    name: str, scene: tuple[nc.System, nc.State], base: compiled.Rollout, steps: int, repeats: int
) -> dict[str, Any]:
    """Time, size and compilation of one scene; its time beside that of the base."""
    system, state = scene
    structure, rollout = system.structure, _rollout(system, state, steps)
    _, timing = common.timed_in_turn([base.run, rollout.run], steps, repeats)
    inputs = jnp.full((steps, len(structure.inputs)), 0.1)
    lowered = jax.jit(lambda s, x, u: nc.simulate(s, x, dt=DT, inputs=u)).lower(system, state, inputs)
    trajectory = rollout.run()
    return {
        "effect": name,
        **rollout.about,
        "unknowns": structure.unknowns,
        "multipliers": structure.multipliers,
        "program": len(lowered.as_text().splitlines()),
        "newton_iterations_mean": int(trajectory.iterations) / max(int(trajectory.steps_taken), 1),
        "energy_balance": float(nc.balance(system, trajectory).energy.max()),
        "result": "successful" if int(trajectory.result) == 0 else system.explain(trajectory),
        **timing,
    }


COLUMNS = {
    "effect": ("scene", ""),
    "us_per_step": ("µs/step", ".2f"),
    "over_first": ("over base", ".2f"),
    "unknowns": ("unknowns", "d"),
    "multipliers": ("multipliers", "d"),
    "newton_iterations_mean": ("Newton", ".1f"),
    "program": ("program", "d"),
    "compile_s": ("compile s", ".1f"),
}


def draw(results: dict[str, Any]) -> Any:
    """Times a step and times of compilation as bars."""
    from matplotlib.figure import Figure

    runs = results["runs"]
    figure = Figure(figsize=(11, 6), layout="constrained")
    speed, compiling = figure.subplots(1, 2, sharey=True)
    names = [r["effect"] for r in runs]
    speed.barh(names, [r["us_per_step"] for r in runs])
    compiling.barh(names, [r["compile_s"] for r in runs], color="C1")
    speed.invert_yaxis()
    speed.set(xlabel="µs a step")
    compiling.set(xlabel="s of compilation")
    figure.suptitle(common.environment_line(results), fontsize=9)
    return figure


def main() -> None:
    """Run the benchmark."""
    chosen = common.parser("What each effect adds.", "the figure").parse_args()
    if chosen.redraw:
        common.redraw(chosen.redraw, draw)
        return
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    results = common.circumstances("effects", quick=chosen.quick)
    steps, repeats = (50, 3) if chosen.quick else (STEPS, 51)
    names = list(EFFECTS)[:3] if chosen.quick else list(EFFECTS)
    scenes = {"base": build(None), "base without gravity": build(None, gravity=False)}
    scenes |= {f"+ {name}": build(EFFECTS[name]) for name in names}
    base = _rollout(*scenes["base"], steps)
    runs = [measure(name, scene, base, steps, repeats) for name, scene in scenes.items()]
    kept = [common.target(f"balance of energy, {r['effect']}", r["energy_balance"], 1e-11) for r in runs]
    results |= {"runs": runs, "targets": kept}
    print(f"{common.environment_line(results)}\n{common.columns(runs, COLUMNS)}")
    missed = [t for t in kept if not t["reached"]]
    print(common.show_targets(missed) if missed else "energy balances to 1e-11 in all of them")
    common.write(results, draw, common.folder(chosen))


if __name__ == "__main__":
    main()
