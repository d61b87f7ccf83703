"""Writes `open_tree_reference.json`: the converged final state of the open tree, and how others agree.

usage: python -m benchmarks.peers.make_reference
"""

import json
from pathlib import Path

import numpy as np

from benchmarks.peers import exudyn_models, mujoco_models, open_tree
from benchmarks.peers.measure import potential_energy

STEPS = round(open_tree.T_END / 1e-4)
FILE = Path(__file__).with_name("open_tree_reference.json")


def reference() -> dict:
    """The reference, and the largest deviation of a centre of mass [m] from it in other runs."""
    best = mujoco_models.run("open_tree", STEPS, integrator="RK4", repeats=1)
    others = {
        "MuJoCo RK4, h = 2e-4": mujoco_models.run("open_tree", STEPS // 2, integrator="RK4", repeats=1),
        "Exudyn kinematic tree, RK44, h = 2e-4": exudyn_models.run(
            "open_tree", STEPS // 2, formulation="tree", repeats=1
        ),
        "Exudyn redundant, generalised alpha, h = 2e-4": exudyn_models.run(
            "open_tree", STEPS // 2, repeats=1
        ),
    }
    deviations = {
        name: float(np.abs(np.subtract(run["positions"], best["positions"])).max())
        for name, run in others.items()
    }
    start = potential_energy(
        open_tree,
        np.array([body["com"] for body in open_tree.BODIES]),
        np.tile(np.eye(3), (len(open_tree.BODIES), 1, 1)),
    )
    exudyn = others["Exudyn kinematic tree, RK44, h = 2e-4"]["version"]
    return {
        "origin": f"MuJoCo {best['version']}, RK4, h = 1e-4 s, written by benchmarks.peers.make_reference",
        "compared_with": f"Exudyn {exudyn}",
        "t_end": open_tree.T_END,
        "bodies": [body["name"] for body in open_tree.BODIES],
        "positions": best["positions"],
        "energy_start": start,
        "energy": best["energy"],
        "kinetic_energy": best["kinetic_energy"],
        "position_deviations": deviations,
    }


if __name__ == "__main__":
    FILE.write_text(json.dumps(reference(), indent=2) + "\n")
