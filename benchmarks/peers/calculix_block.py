"""The block of `benchmarks.solids` by CalculiX (Debian's `calculix-ccx`): trapezoidal rule, bricks C3D8.

usage: python calculix_block.py REFINEMENT STEPS

Prints one line of JSON: time a step, of the whole run by the process's clock since there is none of steps;
iterations, where the tip is, and how far the energy drifts, relative to the largest kinetic energy.
"""

import json
import os
import re
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

REFINEMENT, STEPS = int(sys.argv[1]), int(sys.argv[2])
STEP, GRAVITY, DENSITY, MODULUS, POISSON = 1e-3, 9.81, 1000.0, 1e6, 0.3
COUNTS, SIZE = np.array([8, 2, 2]) * REFINEMENT, np.array([1.0, 0.25, 0.25])
SEEN = 10
"""Steps from one energy to the next: more of them would take time to write."""

numbers = np.arange(1, 1 + np.prod(COUNTS + 1)).reshape(COUNTS + 1)
around = ((0, 0), (1, 0), (1, 1), (0, 1))
cells = np.array(
    [
        [numbers[i + a, j + b, k + c] for c in (0, 1) for a, b in around]
        for i, j, k in np.ndindex(*(int(n) for n in COUNTS))
    ]
)
places = np.array(list(np.ndindex(*(int(n) for n in COUNTS + 1)))) * SIZE / COUNTS
weights = np.bincount(cells.ravel() - 1) * DENSITY * np.prod(SIZE) / (8 * len(cells))
tip = int(numbers[-1, COUNTS[1] // 2, COUNTS[2] // 2])

shear, compliance = MODULUS / (2 * (1 + POISSON)), 6 * (1 - 2 * POISSON) / MODULUS
lines = ["*NODE, NSET=ALL", *(f"{n}, {x:.12f}, {y:.12f}, {z:.12f}" for n, (x, y, z) in enumerate(places, 1))]
lines += ["*ELEMENT, TYPE=C3D8, ELSET=BLOCK"]
lines += [", ".join(map(str, [n, *cell])) for n, cell in enumerate(cells, 1)]
lines += ["*NSET, NSET=HELD", *map(str, numbers[0].ravel())]
lines += ["*MATERIAL, NAME=RUBBER", "*HYPERELASTIC, NEO HOOKE", f"{shear / 2:.12e}, {compliance:.12e}"]
lines += ["*DENSITY", f"{DENSITY}", "*SOLID SECTION, ELSET=BLOCK, MATERIAL=RUBBER", "*BOUNDARY", "HELD, 1, 3"]
lines += [f"*STEP, NLGEOM, INC={20 * STEPS}", "*DYNAMIC, DIRECT, ALPHA=0", f"{STEP}, {STEP * STEPS}"]
lines += ["*DLOAD", f"BLOCK, GRAV, {GRAVITY}, 0., 0., -1."]
lines += [f"*NODE PRINT, NSET=ALL, FREQUENCY={SEEN}", "U"]
lines += [f"*EL PRINT, ELSET=BLOCK, TOTALS=ONLY, FREQUENCY={SEEN}", "ELSE, ELKE", "*END STEP", ""]

with tempfile.TemporaryDirectory() as folder:
    job = Path(folder) / "job"
    job.with_suffix(".inp").write_text("\n".join(lines))
    run = subprocess.run(
        ["ccx", "-i", "job"], cwd=folder, env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    history = job.with_suffix(".sta").read_text().splitlines()[2:]
    printed = job.with_suffix(".dat").read_text()

iterations = [int(line.split()[3]) for line in history if len(line.split()) >= 6]
moved = [
    np.array([line.split() for line in block.splitlines() if line.strip()], float)[:, 1:]
    for block in re.findall(r"displacements .*?\n\n(.*?)(?:\n\n|\Z)", printed, re.S)
]
stored, kinetic = (
    np.array(re.findall(rf"total {name} .*?\n\s*\n?\s*(\S+)", printed), float)
    for name in ("internal energy", "kinetic energy")
)
height = GRAVITY * np.array([weights @ u[:, 2] for u in moved])
version = re.search(r"Version ([\d.]+)", run.stdout)
print(
    json.dumps(
        {
            "code": f"CalculiX {version[1] if version else '?'}",
            "us_per_step": 1e6 * (used.ru_utime + used.ru_stime) / STEPS,
            "newton_iterations_mean": float(np.mean(iterations)),
            "energy_balance": float(np.abs(stored + kinetic + height).max() / kinetic.max()),
            "tip": float(moved[-1][tip - 1, 2]),
        }
    )
)
