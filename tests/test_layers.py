"""The architecture, held by reading every module's imports: they only point down, and stay at the top of the file."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import apcc_torch

PACKAGE = "apcc_torch"
ROOT = Path(apcc_torch.__file__).resolve().parent
MAX_LINES = 330

# From the bottom up. A unit (a module, or a folder with all it holds) may import itself and the units of lower lines,
# never another unit of its own line. The longest name wins: "report.__main__" is a program, the rest of report is not.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("beginning", "plain_text"),
    ("errors",),
    ("bars", "conf_path", "files", "modes", "processes", "spread"),
    ("annotations",),
    ("settings", "shapes"),
    ("part", "web_address"),
    ("classes",),
    ("reading",),
    ("repetition",),
    ("native",),
    ("linalg",),
    ("lie",),
    ("model",),
    ("estimation",),
    ("control",),
    ("simulation",),
    ("recordings",),
    ("identification",),
    ("evaluation",),
    ("",),  # apcc_torch/__init__.py, the public surface
    ("envs", "hardware"),
    ("exporting",),
    ("composition",),
    ("report",),
    ("viewing",),
    ("messages",),
    ("experiments",),
    ("paper",),
    ("completion", "sweeps"),
    ("composed", "demo", "model_file", "new_arm", "robot_log", "simulate"),
    ("benchmark", "evaluate", "export", "identify", "report.__main__", "robot", "view"),
)

# What a unit does without, though it lies below: real devices know no simulation, and get the simulated arm's plant.
APART: dict[str, frozenset[str]] = {"hardware": frozenset({"simulation"})}

# Who alone may import a heavy or program-only library.
RESTRICTED: dict[str, frozenset[str]] = {
    "hydra": frozenset(
        {"benchmark", "completion", "composed", "evaluate", "export", "identify", "robot", "simulate", "sweeps"}
    ),
    "matplotlib": frozenset({"report", "report.__main__"}),
    "gymnasium": frozenset({"envs"}),
    "stable_baselines3": frozenset({"envs"}),
    "sklearn": frozenset({"evaluation"}),
    "pooch": frozenset({"recordings"}),
    "rosbags": frozenset({"recordings"}),
    "foxglove": frozenset({"messages"}),
    "viser": frozenset({"viewing"}),
}

LEVEL = {unit: level for level, units in enumerate(LAYERS) for unit in units}


@cache
def modules() -> dict[str, Path]:
    """Every module's dotted name below the package ("" for the package itself) and its file."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(modules()[module].read_text(encoding="utf-8"))


def unit_of(module: str) -> str | None:
    """The unit of the layer table that holds the module; None if it has no place there."""
    if not module:
        return ""
    parts = module.split(".")
    prefixes = (".".join(parts[:k]) for k in range(len(parts), 0, -1))
    return next((prefix for prefix in prefixes if prefix in LEVEL), None)


def imported(node: ast.AST, module: str) -> Iterator[str]:
    """The full dotted names that one import statement names, a relative one made absolute."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        base = node.module or ""
        if node.level:
            here = [PACKAGE, *module.split(".")] if module else [PACKAGE]
            is_package = modules()[module].name == "__init__.py"
            drop = node.level - 1 if is_package else node.level
            base = ".".join([*here[: len(here) - drop], *([node.module] if node.module else [])])
        yield from (f"{base}.{alias.name}" for alias in node.names)


def own(name: str) -> str | None:
    """The module of ours that an imported name lies in ("" for the package itself), or None for another library's."""
    if name != PACKAGE and not name.startswith(PACKAGE + "."):
        return None
    inner = name[len(PACKAGE) + 1 :]
    while inner and inner not in modules():
        inner = inner.rpartition(".")[0]
    return inner


@cache
def all_imports(module: str) -> frozenset[str]:
    """The full dotted names that a module imports anywhere."""
    return frozenset(name for node in ast.walk(tree(module)) for name in imported(node, module))


def own_imports(module: str) -> set[str]:
    return {target for target in map(own, all_imports(module)) if target is not None}


def test_every_module_has_a_layer() -> None:
    missing = [module for module in modules() if unit_of(module) is None]
    assert not missing, f"{missing} have no line in LAYERS"


def test_imports_point_down() -> None:
    wrong = []
    for module in modules():
        unit = unit_of(module)
        assert unit is not None
        for target in own_imports(module):
            to = unit_of(target)
            assert to is not None, f"{module} imports {target}, which has no line in LAYERS"
            if to != unit and LEVEL[to] >= LEVEL[unit]:
                wrong.append(f"{module or PACKAGE} must not import {target or PACKAGE}")
    assert not wrong, "\n".join(wrong)


def test_units_that_stay_apart() -> None:
    wrong = [
        f"{module} must do without {target}"
        for module in modules()
        for target in own_imports(module)
        if unit_of(target) in APART.get(unit_of(module) or "", ())
    ]
    assert not wrong, "\n".join(wrong)


def test_restricted_libraries() -> None:
    wrong = [
        f"{module or PACKAGE} must not import {library}"
        for module in modules()
        for library in {name.partition(".")[0] for name in all_imports(module)} & RESTRICTED.keys()
        if unit_of(module) not in RESTRICTED[library]
    ]
    assert not wrong, "\n".join(wrong)


def test_no_own_import_inside_a_function() -> None:
    wrong = []
    for module in modules():
        nodes = ast.walk(tree(module))
        functions = (node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))
        inner = (node for function in functions for node in ast.walk(function))
        lines = {node.lineno for node in inner if any(own(name) is not None for name in imported(node, module))}
        if lines:
            wrong.append(f"{module or PACKAGE} imports our own modules inside a function at lines {sorted(lines)}")
    assert not wrong, "\n".join(wrong)


def test_every_file_is_short() -> None:
    lines = {module: len(path.read_text(encoding="utf-8").splitlines()) for module, path in modules().items()}
    wrong = [
        f"{modules()[module].name} has {n} lines; split it by nouns" for module, n in lines.items() if n > MAX_LINES
    ]
    assert not wrong, "\n".join(wrong)


def test_no_import_cycle() -> None:
    sorter = TopologicalSorter({module: own_imports(module) - {module} for module in modules()})
    try:
        sorter.prepare()
    except CycleError as error:
        pytest.fail("import cycle: " + " -> ".join(name or PACKAGE for name in error.args[1]))


def test_every_folder_is_a_package() -> None:
    folders = {path.parent for path in modules().values()}
    missing = [str(folder.relative_to(ROOT)) for folder in sorted(folders) if not (folder / "__init__.py").is_file()]
    assert not missing, f"folders without __init__.py: {missing}"


def test_import_stays_light() -> None:
    code = f"import sys, {PACKAGE}; print([name for name in {sorted(RESTRICTED)} if name in sys.modules])"
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT.parent), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]", f"import {PACKAGE} pulls in {done.stdout.strip()}"
