"""The block of `benchmarks.solids` by Kratos Multiphysics: trapezoidal rule, total Lagrangian, sparse LU.

usage: python kratos_block.py REFINEMENT STEPS

Prints one line of JSON: time a step by the process's clock, Newton iterations, where the tip is, and how far
the energy drifts, relative to the largest kinetic energy.
"""

import json
import statistics
import sys
import time

import KratosMultiphysics as Kratos
import numpy as np
from KratosMultiphysics import StructuralMechanicsApplication as Structural
from KratosMultiphysics.python_linear_solver_factory import ConstructSolver

import KratosMultiphysics.ConstitutiveLawsApplication  # noqa: F401, isort: skip
import KratosMultiphysics.LinearSolversApplication  # noqa: F401, isort: skip

REFINEMENT, STEPS = int(sys.argv[1]), int(sys.argv[2])
STEP, GRAVITY = 1e-3, 9.81
COUNTS = 8 * REFINEMENT, 2 * REFINEMENT, 2 * REFINEMENT
SIZE = 1.0, 0.25, 0.25

Kratos.Logger.GetDefaultOutput().SetSeverity(Kratos.Logger.Severity.WARNING)
part = Kratos.Model().CreateModelPart("block")
part.SetBufferSize(2)
for variable in ("DISPLACEMENT", "REACTION", "VELOCITY", "ACCELERATION", "VOLUME_ACCELERATION"):
    part.AddNodalSolutionStepVariable(getattr(Kratos, variable))
info = part.ProcessInfo
info[Kratos.DOMAIN_SIZE] = 3
info[Structural.RAYLEIGH_ALPHA] = info[Structural.RAYLEIGH_BETA] = 0.0
rubber = part.CreateNewProperties(1)
rubber.SetValue(Kratos.YOUNG_MODULUS, 1e6)
rubber.SetValue(Kratos.POISSON_RATIO, 0.3)
rubber.SetValue(Kratos.DENSITY, 1000.0)
law = Kratos.KratosGlobals.Kernel.GetConstitutiveLaw("HyperElastic3DLaw")
rubber.SetValue(Kratos.CONSTITUTIVE_LAW, law.Clone())

numbers = np.arange(1, 1 + np.prod([n + 1 for n in COUNTS])).reshape([n + 1 for n in COUNTS])
for index, number in np.ndenumerate(numbers):
    part.CreateNewNode(int(number), *(s * i / n for s, i, n in zip(SIZE, index, COUNTS)))
around = ((0, 0), (1, 0), (1, 1), (0, 1))
for number, (i, j, k) in enumerate(np.ndindex(*COUNTS), 1):
    corners = [int(numbers[i + a, j + b, k + c]) for c in (0, 1) for a, b in around]
    part.CreateNewElement("TotalLagrangianElement3D8N", number, corners, rubber)
for axis in "XYZ":
    degree, reaction = (getattr(Kratos, f"{name}_{axis}") for name in ("DISPLACEMENT", "REACTION"))
    Kratos.VariableUtils().AddDof(degree, reaction, part)
for node in part.Nodes:
    for row in (0, 1):
        node.SetSolutionStepValue(Kratos.VOLUME_ACCELERATION, row, [0.0, 0.0, -GRAVITY])
    if node.X0 == 0.0:
        for axis in "XYZ":
            node.Fix(getattr(Kratos, f"DISPLACEMENT_{axis}"))
    else:
        for row in (0, 1):
            node.SetSolutionStepValue(Kratos.ACCELERATION, row, [0.0, 0.0, -GRAVITY])

solver = ConstructSolver(Kratos.Parameters('{"solver_type": "LinearSolversApplication.sparse_lu"}'))
scheme = Structural.StructuralMechanicsBossakScheme(
    Kratos.Parameters('{"damp_factor_m": 0.0, "newmark_beta": 0.25}')
)
builder = Kratos.ResidualBasedBlockBuilderAndSolver(solver)
criterion = Kratos.DisplacementCriteria(1e-6, 1e-14)
given = part, scheme, criterion, builder, 25, False, False, True
strategy = Kratos.ResidualBasedNewtonRaphsonStrategy(*given)
for said in (criterion, strategy):
    said.SetEchoLevel(0)
strategy.Initialize()

nodes, elements = list(part.Nodes), list(part.Elements)
where = np.array([[n.Id - 1 for n in e.GetNodes()] for e in elements])
own, masses = Kratos.Matrix(), []
for element in elements:
    element.CalculateMassMatrix(own, info)
    masses.append(np.array(own).reshape(8, 3, 8, 3)[:, 0, :, 0])
masses = np.array(masses)
weights = np.bincount(where.reshape(-1), masses.sum(axis=2).reshape(-1))


def energies() -> tuple[float, float, float]:
    """Kinetic, of the weight, stored [J]."""
    speed = np.array([n.GetSolutionStepValue(Kratos.VELOCITY) for n in nodes])[where]
    down = np.array([n.GetSolutionStepValue(Kratos.DISPLACEMENT)[2] for n in nodes])
    density = sum(sum(e.CalculateOnIntegrationPoints(Kratos.STRAIN_ENERGY, info)) for e in elements)
    kinetic = 0.5 * np.einsum("eac,eab,ebc->", speed, masses, speed)
    return kinetic, GRAVITY * weights @ down, density * np.prod(SIZE) / (8 * len(elements))


seconds, iterations, found = [], [], []
for step in range(1, STEPS + 1):
    part.CloneTimeStep(step * STEP)
    info[Kratos.STEP], info[Kratos.DELTA_TIME] = step, STEP
    began = time.process_time()
    strategy.InitializeSolutionStep()
    strategy.Predict()
    if not strategy.SolveSolutionStep():
        raise RuntimeError(f"step {step} did not converge")
    strategy.FinalizeSolutionStep()
    seconds.append(time.process_time() - began)
    iterations.append(int(info[Kratos.NL_ITERATION_NUMBER]))
    found.append(energies())
total = np.sum(found, axis=1)
tip = nodes[int(numbers[-1, COUNTS[1] // 2, COUNTS[2] // 2]) - 1]
print(
    json.dumps(
        {
            "code": f"Kratos {Kratos.KratosGlobals.Kernel.Version()}",
            "us_per_step": 1e6 * statistics.median(seconds),
            "newton_iterations_mean": float(np.mean(iterations)),
            "energy_balance": float(np.abs(total).max() / max(x[0] for x in found)),
            "tip": float(tip.GetSolutionStepValue(Kratos.DISPLACEMENT)[2]),
        }
    )
)
