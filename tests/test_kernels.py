"""Rules for kernels that cannot be seen when they run."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("shiftsim", "planners", "metrics", "data")
MAKES_ARRAYS = re.compile(r"\bnp\.(array|copy|empty|full|ones|zeros)|\.(copy|reshape)\(")


def kernels(decorator: str) -> dict[str, tuple[str, ast.FunctionDef]]:
    """Functions under a decorator: source text and syntax tree, by file and name."""
    out = {}
    for path in (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        text = path.read_text()
        for node in ast.parse(text).body if "kernel" in text else ():
            if isinstance(node, ast.FunctionDef) and any(
                isinstance(name, ast.Name) and name.id == decorator for name in node.decorator_list
            ):
                out[f"{path}:{node.name}"] = (ast.get_source_segment(text, node) or "", node)
    return out


def test_lean_kernels_make_and_receive_no_arrays() -> None:
    # their references would never be given back
    lean, usual = kernels("lean_kernel"), kernels("kernel")
    returning = {
        name
        for name, (_, node) in usual.items()
        if node.returns is not None and "Array" in ast.unparse(node.returns)
    }
    public = {name.rpartition(":")[2] for name in returning}

    assert len(lean) > 50
    for name, (text, node) in lean.items():
        called = {
            call.func.id
            for call in ast.walk(node)
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)
        }
        assert not MAKES_ARRAYS.search(text), name
        assert node.returns is None or "Array" not in ast.unparse(node.returns), name
        file = name.rpartition(":")[0]
        own = {other for other in called if f"{file}:{other}" in lean.keys() | usual.keys()}
        assert not {f"{file}:{other}" for other in own} & returning, name
        assert not (called - own) & public, name
