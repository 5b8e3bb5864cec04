"""Who may import whom: data flows one way, and so do imports."""

import ast
import graphlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
# Who may import whom: a package may use those of lower layers, and itself.
LAYERS = (
    {"_version", "errors", "files", "geometry", "kernels", "processes"},
    {"world"},
    {"sim", "metrics", "data", "planners", "edits"},
    {"runs"},
    {"report", "view", "verify", "env", "train", "compat"},
    {"api", "cli", "benchmarks", "__main__", "__init__"},
)
LAYER = {package: number for number, layer in enumerate(LAYERS) for package in layer}
# what may be used of a neighbour in the same layer
NEIGHBOURS = {
    "planners": (
        "sim.dynamics",
        "sim.loop",
        "sim.noise",
        "sim.plan_check",
        "sim.planner",
    ),
    "metrics": (
        "planners.pdm",
        "planners.proposals",
        "planners.routes",
        "sim.log",
        "sim.planner",
    ),
    "view": ("report.explain", "report.palette", "report.statistics", "report.words"),
    "train": ("env", "report.palette"),
}
LAZY = {"torch", "dask", "distributed", "matplotlib", "gymnasium"}
MAY_IMPORT_TORCH = re.compile(r"planners/learned/(\w+/)?network|/(env|train)/|shims/torch_modules")
SOURCES = sorted(
    path
    for folder in ("shiftsim", "planners", "metrics", "data", "benchmarks")
    for path in (REPOSITORY / folder).rglob("*.py")
    if "speed" not in path.parts
)


def module_of(path):
    """`sim.loop` for shiftsim/sim/loop.py; a package has the name of its folder."""
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    parts = parts[1:] if parts[0] == "shiftsim" else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


MODULES = {module_of(path): path for path in SOURCES}


def imported(tree):
    """(module or name, whether at the top of the file) of every import that is run."""
    top = set(map(id, tree.body))
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.Import):
            yield from ((alias.name, id(node) in top) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            yield from ((f"{node.module}.{alias.name}", id(node) in top) for alias in node.names)


def ours(path):
    """The modules of the project that a file imports, anywhere in it."""
    for name, _ in imported(ast.parse(path.read_text())):
        name = name.removeprefix("shiftsim.") if name.startswith("shiftsim.") else ""
        while name and name not in MODULES:
            name = name.rpartition(".")[0]
        if name and MODULES[name] != path:
            yield name


def open_to_all(package):
    """In the lowest and in the highest layer, neighbours use one another."""
    return LAYER[package] in (0, len(LAYERS) - 1)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_a_module_imports_only_what_its_layer_may(path):
    package = module_of(path).partition(".")[0]
    for name in ours(path):
        other = name.partition(".")[0]
        same_layer = LAYER[other] == LAYER[package]
        if other == package or LAYER[other] < LAYER[package] or (same_layer and open_to_all(other)):
            continue
        assert name.startswith(NEIGHBOURS.get(package, ())), name


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_heavy_libraries_are_imported_where_they_are_used(path):
    if MAY_IMPORT_TORCH.search(path.as_posix()):
        return
    found = {name.split(".")[0] for name, top in imported(ast.parse(path.read_text())) if top}
    assert found & LAZY == set()


@pytest.mark.thorough
def test_no_module_needs_itself():
    graph = {name: set(ours(path)) for name, path in MODULES.items()}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_the_core_works_without_torch():
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "import shiftsim.runs.execute, shiftsim.runs.derive, shiftsim.report.explain\n"
        "import shiftsim.planners.registry, shiftsim.data.store.reading\n"
        "import shiftsim.verify.experiment\n"
        "import shiftsim.cli.doctor\n"
        "print(shiftsim.cli.doctor._torch())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "not installed" in done.stdout


def test_kernels_use_no_fast_math_and_no_threads():
    for path in SOURCES:
        text = path.read_text()
        for word in ("fastmath=", "parallel=True", "prange("):
            assert word not in text, path
