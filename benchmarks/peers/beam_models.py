"""A rope and a cantilever in Exudyn (geometrically exact beam, implicit) and PyElastica (explicit).

Both are a metre long along x, released horizontally under gravity, the rope from a spherical joint, the
cantilever from a clamp; data in `ROPE` and `CANTILEVER`. Written for Exudyn 1.13 and PyElastica 1.0.

Exudyn: nodes with Euler parameters, sparse solver, modified Newton, generalised-alpha with spectral radius
0.9, no files. PyElastica: position Verlet and its own shear factor for circles; the rope is pinned by holding
the position of its first node.

usage: python -m benchmarks.peers.beam_models exudyn|elastica rope|cantilever ELEMENTS STEPS T_END [REPEATS]
"""

import contextlib
import io
import json
import sys
import time
from collections.abc import Callable

import numpy as np

GRAVITY = 9.81
ROPE = {"radius": 0.01, "E": 1e6, "nu": 0.3, "density": 1000.0}
CANTILEVER = {"radius": 0.01, "E": 2e9, "nu": 0.3, "density": 1200.0}
DATA = {"rope": ROPE, "cantilever": CANTILEVER}


def section_of(name: str) -> dict[str, float]:
    """Area, second moment, shear modulus and shear factor."""
    data = DATA[name]
    r, nu = data["radius"], data["nu"]
    return {
        "A": np.pi * r**2,
        "I": np.pi * r**4 / 4,
        "G": data["E"] / (2 * (1 + nu)),
        "k": 6 * (1 + nu) / (7 + 6 * nu),
    }


def exudyn_rollout(
    name: str, elements: int, steps: int, t_end: float
) -> tuple[Callable[[], None], Callable[[], np.ndarray]]:
    """A run that is ready to be timed, and what reads the place of the tip."""
    sys.exudynFast = True  # the documented switch to the module without range checks; it prints a line
    with contextlib.redirect_stdout(io.StringIO()):
        import exudyn as exu
        from exudyn import itemInterface as items  # noqa: N813
        from exudyn.utilities import eulerParameters0
    data, s = DATA[name], section_of(name)
    container = exu.SystemContainer()  # owns the system: it must outlive it
    mbs = container.AddSystem()
    section = exu.BeamSection()
    shear = s["k"] * s["G"] * s["A"]
    bending = data["E"] * s["I"]
    section.stiffnessMatrix = np.diag(
        [data["E"] * s["A"], shear, shear, 2 * s["G"] * s["I"], bending, bending]
    )
    section.inertia = data["density"] * np.diag([2 * s["I"], s["I"], s["I"]])
    section.massPerLength = data["density"] * s["A"]
    length = 1.0 / elements
    nodes = [
        mbs.AddNode(items.NodeRigidBodyEP(referenceCoordinates=[i * length, 0, 0, *eulerParameters0]))
        for i in range(elements + 1)
    ]
    for a, b in zip(nodes, nodes[1:], strict=False):
        beam = mbs.AddObject(
            items.ObjectBeamGeometricallyExact(nodeNumbers=[a, b], physicsLength=length, sectionData=section)
        )
        marker = mbs.AddMarker(items.MarkerBodyMass(bodyNumber=beam))
        mbs.AddLoad(items.LoadMassProportional(markerNumber=marker, loadVector=[0, 0, -GRAVITY]))
    ground = mbs.AddObject(items.ObjectGround())
    if name == "rope":
        ends = [
            mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=ground)),
            mbs.AddMarker(items.MarkerNodePosition(nodeNumber=nodes[0])),
        ]
        mbs.AddObject(items.SphericalJoint(markerNumbers=ends))
    else:
        ends = [
            mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=ground)),
            mbs.AddMarker(items.MarkerNodeRigid(nodeNumber=nodes[0])),
        ]
        mbs.AddObject(items.GenericJoint(markerNumbers=ends))
    mbs.Assemble()
    settings = exu.SimulationSettings()
    settings.timeIntegration.numberOfSteps = steps
    settings.timeIntegration.endTime = t_end
    settings.timeIntegration.verboseMode = 0
    settings.solutionSettings.writeSolutionToFile = False
    settings.solutionSettings.sensorsWritePeriod = t_end
    settings.timeIntegration.newton.useModifiedNewton = True
    settings.linearSolverType = exu.LinearSolverType.EigenSparse
    settings.timeIntegration.generalizedAlpha.spectralRadius = 0.9

    def call(container=container) -> None:
        mbs.SolveDynamic(settings)

    return call, lambda: np.array(mbs.GetNodeOutput(nodes[-1], exu.OutputVariableType.Position))


def exudyn(name: str, elements: int, steps: int, t_end: float) -> tuple[float, np.ndarray]:
    """Wall time of the run [s] and the place of the tip."""
    call, tip = exudyn_rollout(name, elements, steps, t_end)
    start = time.perf_counter()
    call()
    return time.perf_counter() - start, tip()


def elastica(name: str, elements: int, steps: int, t_end: float) -> tuple[float, np.ndarray]:
    """Wall time of the run [s], compiled functions at hand, and the place of the tip."""
    import elastica as ea

    data = DATA[name]

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing):
        """What the run needs."""

    class Pin(ea.ConstraintBase):
        """The first node stays where it is."""

        def constrain_values(self, system, time):
            system.position_collection[..., 0] = 0.0

        def constrain_rates(self, system, time):
            system.velocity_collection[..., 0] = 0.0

    def run(number: int) -> tuple[float, np.ndarray]:
        simulator = Simulator()
        rod = ea.CosseratRod.straight_rod(
            n_elements=elements,
            start=np.zeros(3),
            direction=np.array([1.0, 0, 0]),
            normal=np.array([0, 0, 1.0]),
            base_length=1.0,
            base_radius=data["radius"],
            density=data["density"],
            youngs_modulus=data["E"],
            shear_modulus=section_of(name)["G"],
        )
        simulator.append(rod)
        if name == "rope":
            simulator.constrain(rod).using(Pin)
        else:
            simulator.constrain(rod).using(
                ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
            )
        simulator.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=np.array([0, 0, -GRAVITY]))
        simulator.finalize()
        stepper = ea.PositionVerlet()
        dt, t = t_end / steps, 0.0
        start = time.perf_counter()
        for _ in range(number):
            t = stepper.step(simulator, t, dt)
        return time.perf_counter() - start, rod.position_collection[:, -1].copy()

    run(2)
    return run(steps)


def main() -> None:
    """Print one JSON object."""
    code, name = sys.argv[1:3]
    elements, steps, t_end = int(sys.argv[3]), int(sys.argv[4]), float(sys.argv[5])
    repeats = int(sys.argv[6]) if len(sys.argv) > 6 else 1
    call = {"exudyn": exudyn, "elastica": elastica}[code]
    runs = [call(name, elements, steps, t_end) for _ in range(repeats)]
    wall = float(np.median([r[0] for r in runs]))
    found = {
        "code": code,
        "scene": name,
        "elements": elements,
        "steps": steps,
        "t_end": t_end,
        "wall_s": wall,
        "us_per_step": 1e6 * wall / steps,
        "tip": [float(x) for x in runs[-1][1]],
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
