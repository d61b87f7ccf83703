"""The scenes of `benchmarks.contact` in MuJoCo, MJX and Exudyn: a bouncing ball, and balls on a floor."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from benchmarks import common


def mujoco_model(count: int, dt: float, spring: float | None, *, height: float = 1.1) -> Any:
    """Balls side by side above a floor that they alone touch.

    Args:
        count: of balls.
        dt: step [s].
        spring: stiffness per mass [1/s^2] of contacts without damping; None: the default.
        height: of the centres [m].
    """
    import mujoco

    soft = "" if spring is None else f'solref="{-spring:g} 0"'
    balls = "".join(
        f'<body pos="{0.5 * k} 0 {height}"><freejoint/><geom type="sphere" size="0.1" mass="1" contype="0" '
        f'conaffinity="1" {soft}/></body>'
        for k in range(count)
    )
    floor = f'<geom type="plane" size="100 100 1" conaffinity="0" {soft}/>'
    options = f'<option timestep="{dt}" integrator="implicitfast"/>'
    text = f"<mujoco>{options}<worldbody>{floor}{balls}</worldbody></mujoco>"
    return mujoco.MjModel.from_xml_string(text)


def mujoco_ball(dt: float, spring: float | None, repeats: int) -> tuple[str, Any, dict[str, Any]]:
    """Name, motion (times, heights, energies) and timing of one ball in MuJoCo."""
    import mujoco

    model = mujoco_model(1, dt, spring)
    data, steps = mujoco.MjData(model), round(3.0 / dt)
    z, energy = [1.0], [9.81 * 1.1]
    for _ in range(steps):
        mujoco.mj_step(model, data)
        z.append(data.qpos[2] - 0.1)
        energy.append(9.81 * data.qpos[2] + 0.5 * float(data.qvel[:3] @ data.qvel[:3]))

    def run() -> None:
        mujoco.mj_resetData(model, data)
        mujoco.mj_step(model, data, nstep=steps)

    timing = common.timed(run, steps, repeats)
    name = "MuJoCo" if spring is None else f"MuJoCo, spring {spring:g}"
    return name, (dt * np.arange(steps + 1), np.array(z), np.array(energy)), timing


def exudyn_ball(dt: float, spring: float, repeats: int) -> tuple[str, Any, dict[str, Any]]:
    """The same in Exudyn: a mass on a spring that acts when it is touched, by the trapezoidal rule.

    The time is that of `SolveDynamic` as a whole, which sets up each run anew.
    """
    import exudyn as exu

    items: Any = import_module("exudyn.itemInterface")

    steps, motion = round(3.0 / dt), []

    def run() -> None:
        system = exu.SystemContainer().AddSystem()
        node = system.AddNode(items.NodePoint(referenceCoordinates=[0, 0, 1.0]))
        system.AddObject(items.MassPoint(mass=1.0, nodeNumber=node))
        place = system.AddMarker(items.MarkerNodePosition(nodeNumber=node))
        system.AddLoad(items.Force(markerNumber=place, loadVector=[0, 0, -9.81]))
        ground = system.AddNode(items.NodePointGround())
        ends = [
            system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=ground, coordinate=0)),
            system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=2)),
        ]
        memory = system.AddNode(items.NodeGenericData(initialCoordinates=[1.0], numberOfDataCoordinates=1))
        floor = {"contactStiffness": spring, "contactDamping": 0, "offset": -1.0}
        system.AddObject(items.ObjectContactCoordinate(markerNumbers=ends, nodeNumber=memory, **floor))
        kinds = exu.OutputVariableType.Position, exu.OutputVariableType.Velocity
        sensors = [
            system.AddSensor(items.SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=kind))
            for kind in kinds
        ]
        system.Assemble()
        settings = exu.SimulationSettings()
        settings.timeIntegration.numberOfSteps, settings.timeIntegration.endTime = steps, 3.0
        settings.timeIntegration.generalizedAlpha.spectralRadius = 1.0
        settings.timeIntegration.verboseMode = 0
        settings.solution.file.write, settings.solution.sensors.writePeriod = False, dt
        system.SolveDynamic(settings)
        z, v = (system.GetSensorStoredData(sensor)[:, 3] for sensor in sensors)
        motion[:] = [dt * np.arange(len(z)), z, 9.81 * z + 0.5 * v**2]

    timing = common.timed(run, steps, repeats)
    return f"Exudyn, spring {spring:g}", tuple(motion), timing


def mujoco_many(count: int, dt: float, steps: int, resting: bool) -> Callable[[], object]:
    """Steps of balls that bounce or rest, ready to be timed."""
    import mujoco

    model = mujoco_model(count, dt, None, height=0.1 if resting else 1.1)
    data = mujoco.MjData(model)

    def run() -> None:
        mujoco.mj_resetData(model, data)
        mujoco.mj_step(model, data, nstep=steps)

    return run


def mujoco_cloud(
    places: np.ndarray, velocities: np.ndarray, dt: float, steps: int, spring: float
) -> tuple[Callable[[], object], float]:
    """Steps of balls that collide in free flight, and what their energy has changed by, relatively.

    The energy is that of the motion, and at the end of overlaps, by the spring.
    """
    import mujoco

    balls = "".join(
        f'<body pos="{x} {y} {z}"><freejoint/><geom type="sphere" size="0.1" mass="1" '
        f'solref="{-spring:g} 0"/></body>'
        for x, y, z in places
    )
    options = f'<option timestep="{dt}" integrator="implicitfast" gravity="0 0 0"/><size memory="64M"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{options}<worldbody>{balls}</worldbody></mujoco>")
    data = mujoco.MjData(model)

    def run() -> None:
        mujoco.mj_resetData(model, data)
        data.qvel.reshape(-1, 6)[:, :3] = velocities
        mujoco.mj_step(model, data, nstep=steps)

    run()
    apart = np.linalg.norm(data.qpos.reshape(-1, 7)[:, None, :3] - data.qpos.reshape(-1, 7)[:, :3], axis=-1)
    overlap = np.maximum(0.2 - apart, 0.0)[np.triu_indices(len(places), 1)]
    mujoco.mj_energyVel(model, data)
    before = 0.5 * np.sum(velocities**2)
    after = float(data.energy[1]) + 0.5 * spring * float(np.sum(overlap**2))
    return run, abs(after - before) / before


def mjx_many(count: int, lanes: int, dt: float, steps: int, resting: bool) -> Callable[[], object]:
    """The same in lanes of MJX."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    model = mujoco_model(count, dt, None, height=0.1 if resting else 1.1)
    put = mjx.put_model(model)
    start = mjx.make_data(put)

    def one(shift: Any) -> Any:
        data = start.replace(qpos=start.qpos.at[2::28].add(shift))
        return jax.lax.fori_loop(0, steps, lambda _, d: mjx.step(put, d), data).qpos

    program, shifts = jax.jit(jax.vmap(one)), jnp.linspace(0.0, 0.0 if resting else 0.2, lanes)
    return lambda: program(shifts).block_until_ready()


def mjx_slope(dt: float) -> float:
    """Derivative of the height after one second by that at the start, by MJX's default contact."""
    import jax
    from mujoco import mjx

    put = mjx.put_model(mujoco_model(1, dt, None))
    start = mjx.make_data(put)

    def height(x: Any) -> Any:
        data = start.replace(qpos=start.qpos.at[2].add(x), qvel=start.qvel.at[2].set(0.3))
        steps = round(1 / dt)
        return jax.lax.scan(lambda d, _: (mjx.step(put, d), None), data, None, length=steps)[0].qpos[2]

    # Forward: its solver's loop of unknown length has no other derivative.
    return float(jax.jvp(height, (0.0,), (1.0,))[1])
