"""Who may import whom: data flows one way, and so do imports."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
BASE = {"arrays", "config", "errors", "geometry", "predicates", "state"}
WORLD = {
    "dynamics",
    "layers",
    "log",
    "map",
    "noise",
    "planner",
    "scenario",
    "traffic",
}
LOOP = {"simulation", "plan_check"}
MIDDLE = {"data", "metrics", "planners", *LOOP}
# what a module of row 2 may use besides its own sub-package
ALLOWED = {
    **{name: BASE for name in BASE},
    **{name: BASE | WORLD for name in WORLD},
    **{name: BASE | WORLD | LOOP for name in LOOP},
    "data": BASE | WORLD,
    "metrics": BASE | {"map", "layers", "log"},
    "planners": BASE | WORLD | {"plan_check"},
}
TOP = {"benchmarks", "cli", "__main__"}
LAZY = {"torch", "dask", "distributed", "matplotlib", "gymnasium"}
SOURCES = sorted(
    path
    for folder in ("shiftsim", "planners", "metrics", "data", "benchmarks")
    for path in (REPOSITORY / folder).rglob("*.py")
    if "speed" not in path.parts
)


def part_of(path):
    """The top-level module or sub-package that a source file belongs to."""
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    return parts[1] if parts[0] == "shiftsim" else parts[0]


def imported(tree):
    """(module, whether at the top of the file) of every import."""
    top = set(map(id, tree.body))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, id(node) in top) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            if node.module == "shiftsim":
                yield from ((f"shiftsim.{alias.name}", id(node) in top) for alias in node.names)
            else:
                yield node.module, id(node) in top


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_a_module_imports_only_what_its_layer_may(path):
    part = part_of(path)
    ours, heavy = set(), set()
    for name, at_top in imported(ast.parse(path.read_text())):
        words = name.split(".")
        if words[0] == "shiftsim" and len(words) > 1:
            ours.add(words[1])
        elif at_top and words[0] in LAZY and "nets" not in path.parts:
            heavy.add(words[0])
    ours -= {part, "__version__"}
    assert heavy == set(), "import it inside the function that uses it"
    if part in ALLOWED:
        assert ours - ALLOWED[part] == set()
    elif part not in TOP and part != "__init__":
        assert ours & TOP == set()


def test_the_core_works_without_torch():
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "import shiftsim.runs.execute, shiftsim.runs.rescore, shiftsim.report.explain\n"
        "import shiftsim.planners.registry, shiftsim.data.store.reading, shiftsim.verify\n"
        "import shiftsim.cli.diagnosis\n"
        "print(shiftsim.cli.diagnosis._torch())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "not installed" in done.stdout


def test_kernels_use_no_fast_math_and_no_threads():
    for path in SOURCES:
        text = path.read_text()
        for word in ("fastmath=", "parallel=True", "prange("):
            assert word not in text, path
