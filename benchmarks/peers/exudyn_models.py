"""The benchmark models in Exudyn (written for Exudyn 1.13).

Two formulations: "redundant" is rigid bodies with joints as constraints (implicit solvers), "tree" is the
minimal-coordinate `ObjectKinematicTree`, free of constraints and so open to explicit Runge-Kutta methods. The
settings follow the speed-up list of Exudyn's documentation: module without range checks, modified Newton,
Lie-group nodes with constant mass matrix, no files, no output. Where it leaves a choice (dense linear solver,
when to refresh the Jacobian), the defaults of `run` are what was fastest with these nodes on both models.

Joints that close loops are constraints in both formulations, which leaves implicit solvers. For redundant
constraints the documentation gives two ways: to drop those that depend on others, or to keep them and let
Eigen's LU with full pivoting resolve the singular system (EigenDense and `ignoreSingularJacobian`). Both find
the same motion, to three digits of its error; the first takes some half of the time and is the default. The
tree needs fewer steps than rigid bodies, too. `TrapezoidalIndex2` fails on the four-bars.

usage: python -m benchmarks.peers.exudyn_models MODEL STEPS [formulation=redundant|tree] [solver=RK44|...]
       [spectral_radius=0.9] [node=RotationRotationVector|RotationEulerParameters|RotationRxyz]
       [linear_solver=EigenDense] [jacobian_per_step=true] [redundant=true] [t_end=10 records=1000]
"""

import contextlib
import io
import sys
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np

from benchmarks.peers.measure import (
    MODELS,
    command_line,
    energies,
    final_state,
    loops,
    moving,
    per_step,
    seconds,
    times_per_call,
    turning,
)

sys.exudynFast = True  # the documented switch to the module without range checks; it prints a line
with contextlib.redirect_stdout(io.StringIO()):
    import exudyn as exu
    from exudyn import itemInterface as items  # noqa: N813
    from exudyn.rigidBodyUtilities import RigidBodyInertia

_OUT = exu.OutputVariableType
# Three single turns make a free rotation; this order meets gimbal lock on the heavy top alone, which passes
# the vertical.
_GLOBAL_AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
# The one-coordinate links of a kinematic tree that make up a joint: kind, axis (None: the three global ones).
_LINKS = {
    "free": [("PrismaticZ", None), ("RevoluteZ", None)],
    "revolute": [("RevoluteZ", 0)],
    "spherical": [("RevoluteZ", None)],
    "prismatic": [("PrismaticZ", 0)],
    "universal": [("RevoluteZ", 0), ("RevoluteZ", 1)],
    "cylindrical": [("PrismaticZ", 0), ("RevoluteZ", 0)],
}


def _frame(axis) -> np.ndarray:
    """A rotation matrix whose third column is the unit vector `axis`."""
    z = np.asarray(axis)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _closing(loop: dict, redundant: bool) -> list[int]:
    """What a hinge that closes a loop constrains, in a frame whose third axis is its own."""
    return [1, 1, 1, 1, 1, 0] if redundant else list(loop["independent"])


def _add_joint(mbs, body: dict, parent: int, child: int) -> None:
    """The joint of `body` as a constraint between two Exudyn bodies, with its torsional spring."""
    kind, axes = body["joint"], body["axes"]
    common = dict(itemNumbers=[parent, child], position=body["point"], show=False)
    if kind == "revolute":
        mbs.CreateRevoluteJoint(axis=axes[0], **common)
    elif kind == "spherical":
        mbs.CreateSphericalJoint(**common)
    elif kind == "prismatic":
        mbs.CreatePrismaticJoint(axis=axes[0], **common)
    elif kind == "universal":  # the constraint is y of the parent's marker against z of the child's
        frame = np.column_stack([np.cross(axes[0], axes[1]), axes[0], axes[1]])
        mbs.CreateGenericJoint(rotationMatrixAxes=frame, constrainedAxes=[1, 1, 1, 1, 0, 0], **common)
    elif kind == "cylindrical":
        mbs.CreateGenericJoint(
            rotationMatrixAxes=_frame(axes[0]), constrainedAxes=[1, 1, 0, 1, 1, 0], **common
        )
    if body["stiffness"] or body["damping"]:
        mbs.CreateTorsionalSpringDamper(
            axis=axes[0],
            stiffness=body["stiffness"],
            damping=body["damping"],
            unlimitedRotations=False,
            **common,
        )


def _build_redundant(model, mbs, node: str, redundant: bool):
    """Rigid bodies and constraints; returns a function that reads the state as `final_state` wants it."""
    ground = mbs.CreateGround()
    bodies = []
    for body in model.BODIES:
        inertia = RigidBodyInertia(mass=body["mass"], inertiaTensor=np.diag(body["inertia"]))
        bodies.append(
            mbs.CreateRigidBody(
                inertia=inertia,
                referencePosition=list(body["com"]),
                initialVelocity=list(moving(body)),
                initialAngularVelocity=list(turning(body)),
                show=False,
                gravity=list(model.GRAVITY),
                nodeType=getattr(exu.NodeType, node),
            )
        )
        if body["joint"] != "free":
            _add_joint(mbs, body, ground if body["parent"] is None else bodies[body["parent"]], bodies[-1])
    for loop in loops(model):
        mbs.CreateGenericJoint(
            itemNumbers=[ground if loop[b] is None else bodies[loop[b]] for b in ("body_a", "body_b")],
            position=loop["point"],
            rotationMatrixAxes=_frame(loop["axes"][0]),
            constrainedAxes=_closing(loop, redundant),
            show=False,
        )
    for index, torque in model.MOTORS:
        body = model.BODIES[index]
        for sign, item in ((1.0, index), (-1.0, body["parent"])):
            mbs.CreateTorque(
                itemNumber=bodies[item],
                loadVector=list(sign * torque * np.asarray(body["axes"][0])),
                bodyFixed=True,
            )
    for spring in model.POINT_SPRINGS:
        ends = [spring["body_a"], spring["body_b"]]
        local = [
            np.subtract(spring[p], model.BODIES[b]["com"] if b is not None else np.zeros(3))
            for p, b in zip(("point_a", "point_b"), ends, strict=True)
        ]
        mbs.CreateSpringDamper(
            itemNumbers=[ground if b is None else bodies[b] for b in ends],
            localPosition0=local[0],
            localPosition1=local[1],
            referenceLength=spring["length"],
            stiffness=spring["stiffness"],
            damping=spring["damping"],
            show=False,
        )

    def read():
        outputs = (_OUT.Position, _OUT.RotationMatrix, _OUT.Velocity, _OUT.AngularVelocity)
        state = [np.array([mbs.GetObjectOutputBody(body, output) for body in bodies]) for output in outputs]
        return state[0], state[1].reshape(-1, 3, 3), state[2], state[3]

    return read


def _tree_links(model) -> tuple[list[dict], list[int]]:
    """The links of the kinematic tree, and the index of the link that carries each body."""
    links, carrier = [], []
    for body in model.BODIES:
        root = body["parent"] is None
        parent = -1 if root else carrier[body["parent"]]
        spin = turning(body) - (0.0 if root else turning(model.BODIES[body["parent"]]))
        moves = [
            (kind, axis)
            for kind, which in _LINKS[body["joint"]]
            for axis in (_GLOBAL_AXES if which is None else (body["axes"][which],))
        ]
        for kind, axis in moves:
            links.append(
                dict(
                    kind=kind,
                    parent=parent,
                    frame=_frame(axis),
                    point=np.asarray(body["point"]),
                    mass=0.0,
                    inertia=np.zeros((3, 3)),
                    com=np.zeros(3),
                    stiffness=0.0,
                    damping=0.0,
                    force=0.0,
                    rate=float(np.dot(axis, spin if kind == "RevoluteZ" else moving(body)))
                    if kind == "RevoluteZ" or body["joint"] == "free"
                    else 0.0,
                )
            )
            parent = len(links) - 1
        frame = links[-1]["frame"]  # the massless links before only carry coordinates
        links[-1] |= dict(
            mass=body["mass"],
            inertia=frame.T @ np.diag(body["inertia"]) @ frame,
            com=frame.T @ np.subtract(body["com"], body["point"]),
            stiffness=body["stiffness"],
            damping=body["damping"],
        )
        carrier.append(parent)
    for body, torque in model.MOTORS:
        links[carrier[body]]["force"] = torque
    return links, carrier


def _build_tree(model, mbs, redundant: bool):
    """One kinematic tree; returns a function that reads the state as `final_state` wants it."""
    links, carrier = _tree_links(model)
    frames = [link["frame"] for link in links]
    parent_frames = [np.eye(3) if k["parent"] < 0 else frames[k["parent"]] for k in links]
    parent_points = [np.zeros(3) if k["parent"] < 0 else links[k["parent"]]["point"] for k in links]

    def column(key):
        return [link[key] for link in links]

    zeros, springs = [0.0] * len(links), {}
    if any(column("stiffness")) or any(column("damping")):
        springs = dict(
            jointPControlVector=column("stiffness"),
            jointDControlVector=column("damping"),
            jointPositionOffsetVector=zeros,
            jointVelocityOffsetVector=zeros,
        )
    node = mbs.AddNode(
        items.NodeGenericODE2(
            referenceCoordinates=zeros,
            initialCoordinates=zeros,
            initialCoordinates_t=column("rate"),
            numberOfODE2Coordinates=len(links),
        )
    )
    tree = mbs.AddObject(
        items.ObjectKinematicTree(
            nodeNumber=node,
            gravity=list(model.GRAVITY),
            jointTypes=[getattr(exu.JointType, k) for k in column("kind")],
            linkParents=column("parent"),
            jointTransformations=exu.Matrix3DList(
                [p.T @ f for p, f in zip(parent_frames, frames, strict=True)]
            ),
            jointOffsets=exu.Vector3DList(
                [f.T @ (k["point"] - p) for f, k, p in zip(parent_frames, links, parent_points, strict=True)]
            ),
            linkInertiasCOM=exu.Matrix3DList(column("inertia")),
            linkCOMs=exu.Vector3DList(column("com")),
            linkMasses=column("mass"),
            jointForceVector=column("force"),
            **springs,
        )
    )

    def marker(body, point, axes=None):
        if body is None:
            place = exu.HT(rotation=np.eye(3) if axes is None else axes, translation=np.asarray(point))
            return mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=mbs.CreateGround(), localHT=place))
        link = links[carrier[body]]
        back = link["frame"].T
        place = exu.HT(
            rotation=np.eye(3) if axes is None else back @ axes,
            translation=back @ np.subtract(point, link["point"]),
        )
        return mbs.AddMarker(
            items.MarkerKinematicTreeRigid(objectNumber=tree, linkNumber=carrier[body], localHT=place)
        )

    for loop in loops(model):
        axes = _frame(loop["axes"][0])
        mbs.AddObject(
            items.ObjectJointGeneric(
                markerNumbers=[marker(loop[b], loop["point"], axes) for b in ("body_a", "body_b")],
                constrainedAxes=_closing(loop, redundant),
            )
        )
    for s in model.POINT_SPRINGS:
        ends = [marker(s[b], s[p]) for b, p in (("body_a", "point_a"), ("body_b", "point_b"))]
        mbs.AddObject(
            items.ObjectConnectorSpringDamper(
                markerNumbers=ends,
                referenceLength=s["length"],
                stiffness=s["stiffness"],
                damping=s["damping"],
            )
        )
    centres = [marker(i, body["com"]) for i, body in enumerate(model.BODIES)]

    def read():
        position, velocity = (
            [mbs.GetMarkerOutput(m, output) for m in centres] for output in (_OUT.Position, _OUT.Velocity)
        )
        turns = [np.reshape(mbs.GetMarkerOutput(m, _OUT.RotationMatrix), (3, 3)) for m in centres]
        spin = [
            turn @ mbs.GetMarkerOutput(m, _OUT.AngularVelocityLocal)
            for turn, m in zip(turns, centres, strict=True)
        ]
        rotation = [turn @ frames[link].T for turn, link in zip(turns, carrier, strict=True)]
        return position, rotation, velocity, spin

    return read


def _settings(
    steps: int,
    t_end: float,
    solver: str,
    *,
    spectral_radius: float,
    linear_solver: str,
    jacobian_per_step: bool,
    singular: bool,
    records: int,
):
    """Exudyn's simulation settings for speed; sensors are written `records` times after the start."""
    settings = exu.SimulationSettings()
    time = settings.timeIntegration
    time.numberOfSteps, time.endTime, time.verboseMode = steps, t_end, 0
    time.solverType = getattr(exu.DynamicSolverType, solver)
    time.newton.useModifiedNewton = True
    time.newton.modifiedNewtonJacUpdatePerStep = jacobian_per_step
    time.generalizedAlpha.spectralRadius = spectral_radius
    time.explicit.computeEndOfStepAccelerations = False
    settings.linearSolver.solverType = getattr(exu.LinearSolverType, linear_solver)
    settings.linearSolver.ignoreSingularJacobian = singular
    settings.solution.file.write, settings.solution.sensors.active = False, records > 0
    if records:
        settings.solution.sensors.writePeriod = t_end / records
    settings.cleanUpMemory = False
    return settings


def rollout(source, steps: int, t_end: float) -> Callable[[], None]:
    """A run of rigid bodies and constraints at the default settings of `run`, ready to be timed.

    Args:
        source: the data, as a module of `benchmarks.peers`.
        steps: number of steps.
        t_end: [s].
    """
    container = exu.SystemContainer()  # owns the system: it must outlive it
    mbs = container.AddSystem()
    _build_redundant(source, mbs, "RotationRotationVector", redundant=False)
    mbs.Assemble()
    options: dict[str, Any] = {"linear_solver": "EigenDense", "jacobian_per_step": True}
    fixed: dict[str, Any] = {"spectral_radius": 0.9, "singular": False, "records": 0}
    settings = _settings(steps, t_end, "GeneralizedAlpha", **options, **fixed)
    settings.timeIntegration.reuseConstantMassMatrix = True

    def call(container=container) -> None:
        mbs.SolveDynamic(settings)

    return call


def run(
    model: str,
    steps: int,
    *,
    formulation: str = "redundant",
    solver: str | None = None,
    spectral_radius: float = 0.9,
    node: str = "RotationRotationVector",
    linear_solver: str = "EigenDense",
    jacobian_per_step: bool = True,
    redundant: bool = False,
    t_end: float | None = None,
    records: int = 0,
    repeats: int = 7,
) -> dict:
    """Times `steps` steps over [0, t_end] and returns times and final state.

    Args:
        model: a name in `MODELS`.
        steps: number of steps.
        formulation: "redundant" or "tree".
        solver: a name in exudyn.DynamicSolverType; default GeneralizedAlpha for "redundant", RK44 for "tree".
        spectral_radius: of generalised alpha at infinite frequency; below 1 where there are constraints.
        node: rotation parameters of a rigid body in the redundant formulation; the default, a Lie-group node,
            has a constant mass matrix, which is then reused. RotationEulerParameters was up to 10 % faster,
            with about the same error of position and 5 to 13 times the error of the spacecraft's energy.
        linear_solver: a name in exudyn.LinearSolverType.
        jacobian_per_step: one Jacobian per step in the modified Newton method; false, Exudyn's default: when
            convergence asks for one.
        redundant: close loops with all constraints of their joints and solve in the sense of least squares,
            instead of dropping those that depend on others.
        t_end: [s]; None: `T_END` of the model.
        records: number of times at which `energies` are recorded besides the start (in "records"); the run is
            then made once. 0: none.
        repeats: timed repetitions.
    """
    source = MODELS[model]
    end = source.T_END if t_end is None else t_end
    solver = solver or {"redundant": "GeneralizedAlpha", "tree": "RK44"}[formulation]
    container = exu.SystemContainer()  # owns the system: it must outlive it
    mbs = container.AddSystem()
    if formulation == "tree":
        read = _build_tree(source, mbs, redundant)
    else:
        read = _build_redundant(source, mbs, node, redundant)
    sensor = None
    if records:
        sensor = mbs.AddSensor(
            items.SensorUserFunction(
                sensorUserFunction=lambda *_: energies(final_state(source, *read())),
                writeToFile=False,
                storeInternal=True,
            )
        )
    mbs.Assemble()
    options: dict[str, Any] = {
        "spectral_radius": spectral_radius,
        "linear_solver": linear_solver,
        "jacobian_per_step": jacobian_per_step,
    }
    singular = redundant and bool(loops(source))
    settings = _settings(steps, end, solver, **options, singular=singular, records=records)
    settings.timeIntegration.reuseConstantMassMatrix = (
        formulation == "redundant" and node == "RotationRotationVector"
    )
    found = {}
    if sensor is None:
        timing = per_step(times_per_call(lambda: mbs.SolveDynamic(settings), repeats), steps)
    else:
        timing = per_step([seconds(lambda: mbs.SolveDynamic(settings))], steps)
        found = {"records": mbs.GetSensorStoredData(sensor)[:, 1:].tolist()}
    if solver not in ("GeneralizedAlpha", "TrapezoidalIndex2"):
        options = {"linear_solver": linear_solver}
    if loops(source):
        options["redundant"] = redundant
    options |= {"formulation": formulation, "solver": solver} | (
        {"node": node} if formulation == "redundant" else {}
    )
    return {
        "peer": "exudyn",
        "version": version("exudyn"),
        "model": model,
        "steps": steps,
        "h": end / steps,
        "settings": options,
        **timing,
        **final_state(source, *read()),
        **found,
    }


if __name__ == "__main__":
    command_line(run)
