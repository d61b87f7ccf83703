"""A cantilever plate that falls from rest, in Kratos: thick corotational quadrilaterals, Newmark's rule.

usage: python kratos_plate.py COUNT STEPS DT

Prints one line of JSON: seconds a step (median), iterations, where the middle of the free edge ends [m].
Newton's iteration stops where corrections are below 1e-6 of the increments; the solver is Kratos' own sparse
LU, the fastest that comes with its wheels.
"""

import json
import statistics
import sys
import time

import KratosMultiphysics as km  # noqa: N813
import KratosMultiphysics.LinearSolversApplication
import KratosMultiphysics.StructuralMechanicsApplication as sma  # noqa: N813
from KratosMultiphysics import python_linear_solver_factory

E, NU, DENSITY, THICKNESS, GRAVITY = 1e7, 0.3, 1000.0, 0.01, -9.81
PAIRS = (("DISPLACEMENT", "REACTION"), ("ROTATION", "REACTION_MOMENT"))
MORE = ("VELOCITY", "ACCELERATION", "ANGULAR_VELOCITY", "ANGULAR_ACCELERATION", "VOLUME_ACCELERATION")


def plate(count: int) -> km.ModelPart:
    """The plate of one metre on count x count elements, held along x = 0."""
    model = km.Model()
    part = model.CreateModelPart("plate")
    part.SetBufferSize(3)
    for name in (*sum(PAIRS, ()), *MORE):
        part.AddNodalSolutionStepVariable(getattr(km, name))
    part.ProcessInfo[km.DOMAIN_SIZE] = 3
    part.ProcessInfo[km.COMPUTE_LUMPED_MASS_MATRIX] = True
    own = part.CreateNewProperties(1)
    for key, value in (
        (km.YOUNG_MODULUS, E), (km.POISSON_RATIO, NU), (km.DENSITY, DENSITY), (km.THICKNESS, THICKNESS),
        (km.CONSTITUTIVE_LAW, sma.ReissnerMindlinShellElasticConstitutiveLaw()),
    ):  # fmt: skip
        own.SetValue(key, value)
    for j in range(count + 1):
        for i in range(count + 1):
            part.CreateNewNode(1 + i + (count + 1) * j, i / count, j / count, 0.0)
    for j in range(count):
        for i in range(count):
            a = 1 + i + (count + 1) * j
            corners = [a, a + 1, a + count + 2, a + count + 1]
            part.CreateNewElement("ShellThickElementCorotational3D4N", 1 + i + count * j, corners, own)
    for name, reaction in PAIRS:
        for axis in "XYZ":
            given = getattr(km, f"{name}_{axis}"), getattr(km, f"{reaction}_{axis}")
            km.VariableUtils().AddDof(*given, part)
    for name in MORE[:4]:
        for axis in "XYZ":
            km.VariableUtils().AddDof(getattr(km, f"{name}_{axis}"), part)
    weight = [0.0, 0.0, GRAVITY]
    for node in part.Nodes:
        for k in range(3):
            node.SetSolutionStepValue(km.VOLUME_ACCELERATION, k, weight)
        if node.X0 < 1e-12:
            for name, _ in PAIRS:
                for axis in "XYZ":
                    node.Fix(getattr(km, f"{name}_{axis}"))
        else:
            for k in range(3):
                node.SetSolutionStepValue(km.ACCELERATION, k, weight)
    return part


def strategy(part: km.ModelPart) -> km.ResidualBasedNewtonRaphsonStrategy:
    """Newmark's rule of order two without damping."""
    given = km.Parameters(json.dumps({"damp_factor_m": 0.0, "newmark_beta": 0.25}))
    scheme = sma.StructuralMechanicsBossakScheme(given)
    linear = km.Parameters('{"solver_type": "LinearSolversApplication.sparse_lu"}')
    builder = km.ResidualBasedBlockBuilderAndSolver(python_linear_solver_factory.ConstructSolver(linear))
    stop = km.MixedGenericCriteria([(km.DISPLACEMENT, 1e-6, 1e-13), (km.ROTATION, 1e-6, 1e-13)])
    stop.SetEchoLevel(0)
    found = km.ResidualBasedNewtonRaphsonStrategy(part, scheme, stop, builder, 25, False, False, True)
    found.SetEchoLevel(0)
    found.Initialize()
    return found


def main() -> None:
    """Run it."""
    km.Logger.GetDefaultOutput().SetSeverity(km.Logger.Severity.WARNING)
    count, steps, dt = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    part = plate(count)
    solving, times, iterations = strategy(part), [], 0
    for step in range(1, steps + 1):
        part.CloneTimeStep(step * dt)
        part.ProcessInfo[km.STEP], part.ProcessInfo[km.DELTA_TIME] = step, dt
        start = time.process_time()
        solving.InitializeSolutionStep()
        solving.Predict()
        if not solving.SolveSolutionStep():
            raise RuntimeError(f"no convergence in step {step}")
        solving.FinalizeSolutionStep()
        times.append(time.process_time() - start)
        iterations += int(part.ProcessInfo[km.NL_ITERATION_NUMBER])
    tip = min(part.Nodes, key=lambda n: (abs(n.X0 - 1.0), abs(n.Y0 - 0.5)))
    found = {
        "code": "Kratos " + km.KratosGlobals.Kernel.Version(),
        "s_per_step": statistics.median(times),
        "iterations": iterations / steps,
        "tip": [tip.X, tip.Y, tip.Z],
    }
    print("RESULT " + json.dumps(found))


if __name__ == "__main__":
    main()
