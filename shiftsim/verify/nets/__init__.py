"""The nets folder: the learned planners with deterministic weights against the official code."""

from contextlib import nullcontext
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from inspect import signature
from pathlib import Path
from typing import Any

from shiftsim.verify.files import read_arrays, read_fields, verify_files
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes

PARTS = {  # sub-folder → module with `FILES`: what compares a file, by glob pattern
    "carl": "nets.carl",
    "diffusion_planner": "nets.diffusion",
    "plantf": "nets.plantf",
    "pluto": "nets.pluto",
    "route_correction": "calls",
}


def verify_nets(folder: Path, report: Report, *, scenes: Path | None = None) -> None:
    """Compare every file of a folder with sub-folders named as the parts, or of one of these.

    `scenes` holds the logs and maps, by default `nuplan` beside `nets`.
    """
    home, part = folder.resolve().parent, _part_of(folder)
    known = Scenes(scenes or (home.parent if part in PARTS else home) / "nuplan")
    if part in PARTS:
        verify_part(part, folder, report, known)
    else:
        parts = {name: partial(verify_part, name, report=report, scenes=known) for name in PARTS}
        verify_files(folder, report, parts)


def _part_of(folder: Path) -> str:
    """Which part a folder is by itself; empty where it holds the parts."""
    if any(folder.glob("route_correction_*.json")):
        return "route_correction"
    manifest = folder / "state_dict.json"
    return str(read_fields(manifest, Report())["planner"]) if manifest.is_file() else ""


def verify_part(part: str, folder: Path, report: Report, scenes: Scenes) -> None:
    """Compare every file of a sub-folder, whose name as in `PARTS` is `part`."""
    is_network = part != "route_correction"
    if is_network and find_spec("torch") is None:
        report.skip(f"{part}: torch is not installed")
        return
    files = import_module(f"shiftsim.verify.{PARTS[part]}").FILES
    parts = {pattern: partial(_verify, files[pattern], report, scenes) for pattern in files}
    with import_module("torch").no_grad() if is_network else nullcontext():
        verify_files(folder, report, parts)


def _verify(compare: Any, report: Report, scenes: Scenes, path: Path) -> None:
    """Compare one file, with its scenes if it asks for them and has one that is at hand."""
    file = (read_arrays if path.suffix == ".npz" else read_fields)(path, report)
    scene = next((str(file[name]) for name in ("meta/scene", "scene") if name in file), None)
    if scene is not None and scene not in scenes:
        report.skip(f"{path.name}: scene {scene}, which is not at hand")
        return
    compare(file, *([scenes] if "scenes" in signature(compare).parameters else []))
    file.finish()
