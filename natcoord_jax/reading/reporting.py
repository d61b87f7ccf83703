"""What a compiled system contains, and how it will be solved, in words."""

from collections import Counter

from natcoord_jax.model.model import Model

REASONS = {
    "reduced": "few unknowns: joint null space along the tree, one dense matrix kept over many steps",
    "recursive": "a large open tree: joint null space, eliminated recursively from leaves to root",
    "sparse": "many loops or couplings: six rates a body, all multipliers, one sparse matrix",
    "full": "loops, or couplings across a tree: six rates a body, all multipliers, one dense matrix",
}


def _count(names: Counter) -> str:
    return ", ".join(f"{number} {name}" for name, number in names.items()) or "none"


def report(system: Model) -> str:
    """Contents, what is clamped, unknowns before and after reduction, the solver and why, warnings."""
    structure = system.structure
    bodies = len(structure.bodies)
    joints, loops = Counter(), Counter()
    for group in system.joints:
        (joints if group.in_tree else loops)[type(group.effect).__name__.lower()] += group.count
    effects = Counter()
    for group in system.effects:
        effects[group.effect.kind] += len(group.names)
    free = sum(1 for name in structure.joints[:bodies] if not name)
    tree = sum(g.count * g.multipliers for g in system.joints if g.in_tree)
    natural = 12 * bodies - 9 * len(structure.points) - 6 * len(structure.directors)
    plan = f", {system.sparsity.plan.name}" if system.sparsity is not None else ""
    held = [f"{n} of {every} nodes of {name!r} to {owner!r}" for name, owner, n, every in structure.clamped]
    lines = [
        f"bodies            {bodies} ({free} free)",
        f"clamped           {', '.join(held) or 'none'}",
        f"joints, tree      {_count(joints)}",
        f"joints, loops     {_count(loops)}",
        f"effects           {_count(effects)}",
        f"inputs            {', '.join(structure.inputs) or 'none'}",
        f"freedom           {structure.dofs} degrees of freedom",
        f"coordinates       {natural} natural coordinates, {structure.constraints} constraints",
        f"unknowns          {natural + structure.constraints} in full; {system.local_rates.count + tree} + "
        f"{structure.multipliers} multipliers in the local null space; {structure.unknowns} + "
        f"{structure.multipliers} multipliers in the joint null space",
        f"solver            {structure.solver}{plan} ({REASONS[structure.solver]})",
        f"levels            {len(system.tree.levels)}",
    ]
    if structure.redundant:
        lines.append(f"redundant         {', '.join(structure.redundant)} (rank {structure.rank})")
    lines += [f"warning           {note}" for note in structure.notes]
    return "\n".join(lines)
