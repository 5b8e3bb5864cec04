"""The nets folder: the learned planners with deterministic weights against the official code."""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from shiftsim.verify.nets.common import ERRORS, Scenes
from shiftsim.verify.nuplan.reading import read_json
from shiftsim.verify.report import Report

PARTS = {  # sub-folder → `module:function` below shiftsim.verify
    "carl": "nets.carl:verify_carl",
    "diffusion_planner": "nets.diffusion:verify_diffusion",
    "plantf": "nets.plantf:verify_plantf",
    "pluto": "nets.pluto:verify_pluto",
    "route_correction": "nets.routes:verify_routes",
}


def verify_nets(folder: Path, report: Report, *, scenes: Path | None = None) -> None:
    """Compare every file of the folder.

    Args:
        folder: Folder with sub-folders named as the parts, or one of these.
        report: Filled with the comparisons.
        scenes: Folder with the logs and maps, by default `nuplan` beside `nets`.
    """
    part = _part_of(folder)
    home = folder.resolve() if part is None else folder.resolve().parent
    known = Scenes(scenes or home.parent / "nuplan")
    if part is not None:
        _verify_part(part, folder, report, known)
        return
    for path in sorted(folder.iterdir()):
        if path.name in PARTS and path.is_dir():
            _verify_part(path.name, path, report, known)
        elif path.suffix == ".md":
            report.note(f"{path.name}: description of the folder")
        else:
            report.skip(f"file {path.name}")


def _part_of(folder: Path) -> str | None:
    """Which part a folder is by itself; None where it holds the parts."""
    if any(folder.glob("route_correction_*.json")):
        return "route_correction"
    manifest = folder / "state_dict.json"
    if manifest.is_file():
        content = read_json(manifest)
        named = content.get("planner") if isinstance(content, dict) else None
        return named if named in PARTS else folder.resolve().name
    return None


def _verify_part(part: str, folder: Path, report: Report, scenes: Scenes) -> None:
    module, _, function = PARTS.get(part, ":").partition(":")
    if not module or find_spec(f"shiftsim.verify.{module}") is None:
        report.skip(f"{part}: nothing compares this folder")
        return
    if find_spec("torch") is None and part != "route_correction":
        report.skip(f"{part}: torch is not installed")
        return
    try:
        getattr(import_module(f"shiftsim.verify.{module}"), function)(folder, report, scenes)
    except ERRORS as error:  # the official code got through, so this is a difference
        report.fail(part, str(folder), f"cannot be compared: {type(error).__name__} {error}")
