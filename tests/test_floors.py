"""The floors of the package: who may import whom, read from the source without running it.

Every import counts, also those inside functions and under ``TYPE_CHECKING``: knowledge is knowledge, whenever
it is loaded. Only ``natcoord_jax/__init__.py``, which gathers the public names, is free of the floors.
"""

import ast
import importlib.util
import inspect
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

PACKAGE = "natcoord_jax"
ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / PACKAGE

# From the ground up. A module imports from its own floor and from those below it.
FLOORS = (
    "xla",
    "native",
    "maths",
    "linsolve",
    "core",
    "mesh",
    "effects",
    "model",
    "mechanics",
    "reading",
    "system",
    "build",
    "bodies",
    "storage",
    "stepping",
    "scene",
    "testing",
    "io",
    "sweeps",
    "analysis",
    "control",
    "viz",
    "gallery",
    "cli",
)
# What a floor must not see although it lies below: the machinery knows kinds and blocks, no effect by name,
# and an effect declares what there is to solve, never how.
BLIND = {
    "core": {"linsolve"},
    "effects": {"linsolve"},
    "model": {"effects", "linsolve"},
    "mechanics": {"effects"},
    "reading": {"effects"},
    "system": {"effects"},
    "build": {"effects"},
    "storage": {"effects", "bodies"},
    "stepping": {"effects", "bodies"},
}
# ``import natcoord_jax`` reaches every floor at once, so it is left to those above all others.
THROUGH_THE_ROOF = {"gallery", "cli"}
# Third parties that linsolve may use beside the standard library.
LINSOLVE_TOOLS = {"jax", "jaxlib", "equinox", "jaxtyping", "numpy"}
# What JAX and XLA may change without notice: to be met in xla/ and native/ only.
UNSTABLE = ("jax._src", "jax.experimental", "jax.extend", "jax.interpreters", "jaxlib")
PLOTTING = {"matplotlib", "mpl_toolkits"}
HEAVY = ("matplotlib", "mujoco", "optax", "scipy.optimize")

LONGEST, LONGEST_FUNCTION = 600, 60
"""Lines of a file, and of a function without its docstring."""
LONGER_FUNCTIONS = {"descend", "factored", "judge", "rollout", "simulate"}

FILES = sorted(SOURCE.rglob("*.py"))


@cache
def parsed(file: Path) -> ast.Module:
    """The syntax tree of a source file; several rules read it."""
    return ast.parse(file.read_text("utf-8"))


@pytest.fixture(scope="module", autouse=True)
def _trees_are_dropped():
    """Trees are millions of objects, of no use to the tests of other files."""
    yield
    parsed.cache_clear()


def module_name(file: Path) -> str:
    """Dotted name of a source file; a folder's ``__init__.py`` bears the name of the folder."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def floor_of(module: str) -> str:
    """Name below the package, empty for the package itself; ``python -m natcoord_jax`` is the cli."""
    parts = module.split(".")
    name = parts[1] if len(parts) > 1 else ""
    return "cli" if name == "__main__" else name


def effect_folder(module: str) -> str:
    """``joints`` of ``natcoord_jax.effects.joints.revolute``; empty for their root and outside of it."""
    parts = module.split(".")
    return parts[2] if len(parts) > 2 and parts[1] == "effects" else ""


def imports(tree: ast.AST, package: str) -> Iterator[tuple[int, str]]:
    """Line and dotted target of every import; ``from a import b`` counts as ``a.b``.

    Args:
        tree: the parsed source.
        package: the package that relative imports start from.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = _absolute("." * node.level + (node.module or ""), package)
            yield from ((node.lineno, base if a.name == "*" else f"{base}.{a.name}") for a in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            name, target = ast.unparse(node.func).rpartition(".")[2], node.args[0].value
            if name in {"import_module", "__import__"} and isinstance(target, str):
                yield node.lineno, _absolute(target, package)


def _absolute(target: str, package: str) -> str:
    level = len(target) - len(target.lstrip("."))
    if level == 0:
        return target
    parts = package.split(".")
    return ".".join([*parts[: len(parts) - level + 1], *filter(None, [target[level:]])])


def breaches(module: str, tree: ast.AST, *, is_package: bool = False) -> list[str]:
    """Every rule that a module breaks, in words.

    Args:
        module: dotted name of the module.
        tree: its parsed source.
        is_package: whether it is the ``__init__.py`` of a folder.
    """
    wrong = [
        f"line {node.lineno}: hasattr; an effect declares what it is, so ask for that"
        for node in ast.walk(tree)
        if isinstance(node, ast.Name) and node.id == "hasattr"
    ]
    floor = floor_of(module)
    if floor and floor not in FLOORS:
        return [*wrong, f"'{floor}' is on no floor; the floors are {' < '.join(FLOORS)}"]
    package = module if is_package else module.rpartition(".")[0]
    for line, target in imports(tree, package):
        ours = target.split(".")[0] == PACKAGE
        reason = _inside(module, floor, target) if ours else _outside(floor, target)
        if reason:
            wrong.append(f"line {line}: imports {target}, but {reason}")
    return wrong


def _inside(module: str, floor: str, target: str) -> str:
    """Why a module may not import this target of our own; empty if it may."""
    if not floor:
        return ""
    other = floor_of(target)
    if other not in FLOORS:
        whole = f"{floor} must name the module it needs, not the whole package"
        return "" if floor in THROUGH_THE_ROOF else whole
    if FLOORS.index(other) > FLOORS.index(floor):
        return f"{other} lies above {floor}"
    if other in BLIND.get(floor, ()):
        return f"{floor} must not know {other}"
    own, theirs = effect_folder(module), effect_folder(target)
    shared = (SOURCE / "effects" / f"{theirs}.py").is_file()
    if own and other == "effects" and theirs != own and not shared:
        return f"effects/{own} must not import other effects; what is shared belongs in core or maths"
    return ""


def _outside(floor: str, target: str) -> str:
    """Why a floor may not import this from a library; empty if it may."""
    library = target.split(".")[0]
    if floor not in ("xla", "native") and f"{target}.".startswith(tuple(f"{name}." for name in UNSTABLE)):
        return "what JAX may change without notice is met in xla and native and nowhere else"
    if library in PLOTTING and floor != "viz":
        return "matplotlib lives in viz and nowhere else"
    if floor == "linsolve" and library not in LINSOLVE_TOOLS | sys.stdlib_module_names:
        return f"linsolve uses {', '.join(sorted(LINSOLVE_TOOLS))} and nothing else"
    return ""


def test_the_package_is_there():
    assert FILES, f"no source found under {PACKAGE}/"


def test_floors():
    """No module imports from a floor above its own, nor breaks one of the other rules."""
    wrong = [
        f"{file.relative_to(ROOT).as_posix()}, {breach}"
        for file in FILES
        for breach in breaches(module_name(file), parsed(file), is_package=file.name == "__init__.py")
    ]
    assert not wrong, "\n".join(wrong)


def test_files_and_functions_can_be_read_at_once():
    """No file is long; long functions are known by name, and the list only shrinks."""
    wrong, long = [], set()
    for file in FILES:
        name = file.relative_to(SOURCE).as_posix()
        length = file.read_text("utf-8").count("\n")
        if length > LONGEST and file.name != "__init__.py":
            wrong.append(f"{name} has {length} lines: split it, at most {LONGEST}")
        for node in ast.walk(parsed(file)):
            if isinstance(node, ast.FunctionDef):
                doc = ast.get_docstring(node, clean=False)
                lines = (node.end_lineno or 0) - node.lineno + 1 - (doc.count("\n") + 1 if doc else 0)
                if lines > LONGEST_FUNCTION:
                    long.add(node.name)
                    if node.name not in LONGER_FUNCTIONS:
                        place = f"{name}, line {node.lineno}: {node.name} has {lines} lines"
                        wrong.append(f"{place}: split it, at most {LONGEST_FUNCTION}")
    wrong += [
        f"{name} is no longer longer than {LONGEST_FUNCTION} lines: it leaves LONGER_FUNCTIONS"
        for name in sorted(LONGER_FUNCTIONS - long)
    ]
    assert not wrong, "\n".join(wrong)


def rows_by_hand(tree: ast.AST) -> list[int]:
    """Lines where an array gets the shape of the rows of nodes by its numbers, (..., 4, 3)."""
    ends = [
        (node.lineno, node.elts if isinstance(node, ast.Tuple) else node.args)
        for node in ast.walk(tree)
        if isinstance(node, ast.Tuple | ast.Call)
    ]
    return [
        line
        for line, items in ends
        if len(items) > 2 and [getattr(x, "value", None) for x in items[-2:]] == [4, 3]
    ]


def test_one_file_knows_how_rows_are_stored():
    """The others take `NODE` and `by_node` of `core/bodies.py`, or `State.rows`."""
    floors = {"core", "model", "mechanics", "stepping", "reading", "analysis", "control"}
    wrong = [
        f"{file.relative_to(ROOT).as_posix()}, line {line}: rows of nodes by their numbers; take by_node"
        for file in FILES
        if file.relative_to(SOURCE).parts[0] in floors
        for line in rows_by_hand(parsed(file))
    ]
    assert not wrong, "\n".join(wrong)


def test_rows_by_hand_are_seen():
    source = "x = q.reshape(-1, 4, 3)\ny = jnp.zeros((2, 4, 3))\nz = jnp.zeros((4, 3))"
    assert rows_by_hand(ast.parse(source)) == [1, 2]


BREACHES = [
    ("core.marker", "from natcoord_jax.effects.joints import Revolute", "effects lies above core"),
    ("core.marker", "from ..scene import Scene", "scene lies above core"),
    ("core.marker", "def f():\n    from .. import viz", "viz lies above core"),
    ("core.marker", "importlib.import_module('natcoord_jax.viz')", "viz lies above core"),
    ("core.marker", "importlib.import_module('..viz', __package__)", "viz lies above core"),
    ("core.marker", "import natcoord_jax as nc", "not the whole package"),
    ("core.marker", "from natcoord_jax import Scene", "not the whole package"),
    ("core.marker", "hasattr(object, 'x')", "hasattr"),
    ("effects.joints.screw", "from ..springs import linear", "must not import other effects"),
    ("effects.joints.screw", "from natcoord_jax.effects import Spring", "must not import other effects"),
    ("mechanics.groups", "from natcoord_jax.effects.joints import Revolute", "must not know effects"),
    ("stepping.newton", "from ..bodies import rigid", "must not know bodies"),
    ("linsolve.dense", "from ..core import state", "core lies above linsolve"),
    ("effects.loads.gravity", "from natcoord_jax.linsolve import dense", "must not know linsolve"),
    ("linsolve.dense", "import scipy.linalg", "nothing else"),
    ("stepping.newton", "from jax.extend import core as jex", "xla and native and nowhere else"),
    ("core.marker", "import jaxlib.xla_client", "xla and native and nowhere else"),
    ("analysis.energy", "import matplotlib.pyplot as plt", "lives in viz"),
    ("helpers", "", "is on no floor"),
]


def test_a_breach_is_seen():
    wrong = []
    for module, source, fragment in BREACHES:
        seen = breaches(f"{PACKAGE}.{module}", ast.parse(source))
        if len(seen) != 1 or fragment not in seen[0]:
            wrong.append(f"{source!r} in {module} gives {seen}, not one breach with '{fragment}'")
    assert not wrong, "\n".join(wrong)


ALLOWED = [
    ("core.marker", "from ..maths import rotations\nfrom .state import State"),
    ("effects.joints.screw", "from .revolute import Revolute\nfrom ...core.marker import Marker"),
    ("linsolve.dense", "import math\nimport jax.numpy as jnp\nfrom natcoord_jax.maths import norms"),
    ("stepping.newton", "from natcoord_jax.linsolve.dense import solve"),
    ("scene", "from . import bodies, effects, stepping"),
    ("viz.plot", "import matplotlib.pyplot as plt\nimport natcoord_jax.analysis.energy"),
    ("gallery.spacecraft", "import natcoord_jax as nc"),
    ("__main__", "from natcoord_jax.cli import main"),
]


def test_what_is_allowed_passes():
    wrong = [
        f"{source!r} in {module}: {breach}"
        for module, source in ALLOWED
        for breach in breaches(f"{PACKAGE}.{module}", ast.parse(source))
    ]
    assert not wrong, "\n".join(wrong)


def test_import_is_light_and_changes_no_setting():
    program = (
        "import json, sys, jax\n"
        "before = dict(jax.config.values)\n"
        f"import {PACKAGE}\n"
        "after = dict(jax.config.values)\n"
        "changed = sorted(k for k in after if k in before and before[k] != after[k])\n"
        f"print(json.dumps([changed, [m for m in {HEAVY!r} if m in sys.modules]]))\n"
    )
    env = {key: value for key, value in os.environ.items() if key != "JAX_ENABLE_X64"}
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=env, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    changed, heavy = json.loads(run.stdout.splitlines()[-1])
    assert not changed, f"import {PACKAGE} changes settings of JAX: {', '.join(changed)}"
    assert not heavy, f"import {PACKAGE} loads {', '.join(heavy)}; import them where they are used"


@pytest.mark.slow
def test_import_takes_less_than_half_a_second(tmp_path):
    """Above what JAX takes, of the processor; on a machine on which JAX takes long, in proportion."""
    program = (
        "import time; begun = time.process_time(); import jax; between = time.process_time()\n"
        f"import {PACKAGE}; print(between - begun, time.process_time() - between)\n"
        "import gc; assert gc.isenabled()"
    )
    env = os.environ | {"PYTHONPYCACHEPREFIX": str(tmp_path), "PYTHONDONTWRITEBYTECODE": ""}
    command = [sys.executable, "-c", program]
    runs = [subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True) for _ in range(11)]
    own, ours = np.array([run.stdout.split() for run in runs[1:]], float).T  # The first compiles.
    # What else the machine does slows either part of a run: the fastest of both may be of different runs.
    assert np.median(ours / np.maximum(0.5, 1.25 * own)) < 1, f"{ours} s, where JAX takes {own} s"


def test_public_names_have_docstrings():
    package = importlib.import_module(PACKAGE)
    assert getattr(package, "__all__", ()), f"{PACKAGE} names nothing in __all__"
    bare = [name for name in package.__all__ if not _documented(getattr(package, name))]
    assert not bare, f"public names without a docstring of their own: {', '.join(bare)}"


def _documented(thing: object) -> bool:
    """Whether a module, class or function has a docstring that somebody wrote; plain values need none."""
    if not (callable(thing) or inspect.ismodule(thing)):
        return True
    doc = (thing.__doc__ or "").strip()
    # A dataclass without a docstring is given its signature for one.
    return bool(doc) and not (inspect.isclass(thing) and doc.startswith(f"{thing.__name__}("))


OF_STRANGERS = ("gallery", "io", "cli")
"""Modules below the package that are as public as its names."""
INSIDE = {
    "conftest.py": "programs are given up, and `--plain`",
    "hunting_protocol.py": "the record that derivatives are taken along: all that the hunt knows of insides",
    "test_accuracy.py": "the rule by which rows of a table are noted",
    "test_arguments.py": "public objects that only calls return",
    "test_control_starts.py": "how far a motion is from being as near as inputs can come",
    "test_decayed_impulses.py": "impulses that underflow, which no scene gives on purpose",
    "test_effort.py": "compilers in other processes",
    "test_elimination.py": "eliminations of small matrices, by their contract",
    "test_errors.py": "result codes",
    "test_gpu.py": "result codes",
    "test_host.py": "evaluation by NumPy, by its contract",
    "test_native.py": "machine code, by its contract with programs of JAX",
    "test_kernels.py": "what is computed in one kernel",
    "test_linsolve.py": "linear solvers, by their contract",
    "test_restitution.py": "the complementarity problem of impacts, by its contract",
    "test_contact_search.py": "arrows in pictures",
    "test_special_points.py": "norms and quotients, by their contract",
    "test_types.py": "a function with checked types",
}
"""Files of tests that import modules below the public ones, and what for. The list only shrinks."""


def test_tests_use_public_names():
    """What a rebuilding of the inside may change is not nailed down by tests."""
    using = set()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        if file == Path(
            __file__
        ):  # (Its sources in quotes are no imports, and it imports the subject whole.)
            continue
        for _, target in imports(ast.parse(file.read_text("utf-8")), ""):
            parts = target.split(".")
            if parts[0] == PACKAGE and len(parts) > 2 and parts[1] not in OF_STRANGERS:
                using.add(file.name)
    wrong = [
        f"{name} imports modules of the inside: take public names" for name in sorted(using - set(INSIDE))
    ]
    wrong += [f"{name} uses public names only: it leaves INSIDE" for name in sorted(set(INSIDE) - using)]
    assert not wrong, "\n".join(wrong)


def missing_names(source: str) -> list[str]:
    """What is taken from modules of the package, by import, attribute or replacement, and is not there."""
    modules, missing, tree = {}, [], ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("natcoord_jax"):
            for name in node.names:
                whole = importlib.import_module(node.module or "")
                found = f"{node.module}.{name.name}"
                if importlib.util.find_spec(found) if hasattr(whole, "__path__") else None:
                    modules[name.asname or name.name] = importlib.import_module(found)
                elif not hasattr(whole, name.name):
                    missing.append(found)
    for node in ast.walk(tree):
        owner, name = None, ""
        if isinstance(node, ast.Attribute):
            owner, name = node.value, node.attr
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "setattr":
            owner, name = node.args[0], getattr(node.args[1], "value", "")
        module = modules.get(owner.id) if isinstance(owner, ast.Name) else None
        if module is not None and not hasattr(module, name):
            missing.append(f"{module.__name__}.{name}")
    return missing


def test_what_tests_take_is_there():
    """Of those, too, that only the exhaustive suite runs."""
    wrong = [
        f"{file.relative_to(ROOT).as_posix()} takes {name}, which is not there"
        for file in sorted(Path(__file__).parent.rglob("*.py"))
        for name in missing_names(file.read_text("utf-8"))
    ]
    assert not wrong, "\n".join(wrong)


def test_missing_names_are_seen():
    source = (
        "from natcoord_jax.stepping import newton, none\nnewton.absent\npatch.setattr(newton, 'gone', 1)\n"
    )
    names = ("none", "newton.absent", "newton.gone")
    assert missing_names(source) == [f"natcoord_jax.stepping.{name}" for name in names]
