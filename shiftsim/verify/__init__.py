"""Compare shiftsim with a folder of reference outputs, recognised by its content.

Every part fills a `Report`; nothing here decides what is equal but the tolerances of the folders'
READMEs and of the project's own promise, whichever is tighter.
"""

from importlib import import_module
from inspect import signature
from pathlib import Path

from shiftsim.errors import DataError
from shiftsim.verify.report import Report

MODES = ("NR", "R", "PT")
KINDS = {  # module of `verify_<kind>`, patterns that must all match something (`a|b`: either)
    "nuplan": ("nuplan", "scenes.json", "expected/*.parquet"),
    "nuplan_format": ("nuplan.format", "devkit_readback.json"),
    "metric_worlds": ("metric_worlds", "metric_world_*.json"),
    "pdm": ("pdm", "kernels/*.npz|kernels/*.json|routes.json|idm_calls.json|loop/steps.parquet"),
    "nets": ("nets", "state_dict.json|route_correction*|plantf|pluto|diffusion_planner|carl"),
    "dynamics": (
        "dynamics",
        "bicycle_*.npz|lqr_commands.npz|closed_loop*.npz|idm_*|comfort_*.npz|ego_*.npz|traj*.npz",
    ),
    "dsc3d_sample": ("dsc3d", "expected_rows.parquet", "data"),
    "dsc3d_synthetic": ("dsc3d", "**/expected_ego_20hz.parquet"),
    "opendrive": ("opendrive", "*.refline.parquet"),
    "scenario_edits": ("scenario_edits", "tokens.json", "build.json", "traffic.json"),
    "experiment": ("nuplan.experiment", "**/aggregator_metric|**/simulation_log"),
}


def verify(
    folder: Path,
    *,
    kind: str | None = None,
    mode: str | None = None,
    scenes: Path | None = None,
    maps: Path | None = None,
    store: str | None = None,
) -> Report:
    """Compare everything in a reference folder with what shiftsim computes.

    Args:
        folder: Reference folder.
        kind: Which of `KINDS` it is; by default it is recognised by its content.
        mode: Only runs of this challenge (`NR`, `R` or `PT`); None for all.
        scenes: Folder with the logs and maps that other folders refer to; by default a folder
            `nuplan` beside `folder`.
        maps: Folder with OpenDRIVE maps; by default a folder `maps` beside the parent of `folder`.
        store: Store with the scenarios of nuPlan's results, by name, path or URL.

    Returns:
        The report.

    Raises:
        DataError: The folder is of no known kind, or a file in it is broken.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    options = {"mode": mode, "scenes": scenes, "maps": maps, "store": store}
    for name, (module, *patterns) in KINDS.items():
        if name == kind or (kind is None and _holds(folder, patterns)):
            part = getattr(import_module(f"shiftsim.verify.{module}"), f"verify_{name}")
            report, takes = Report(), signature(part).parameters
            part(folder, report, **{name: options[name] for name in options if name in takes})
            return report
    raise DataError(
        f"{folder}: not recognised as a folder of reference outputs",
        hint=f"known kinds: {', '.join(KINDS)}",
    )


def _holds(folder: Path, patterns: list[str]) -> bool:
    return all(any(any(folder.glob(p)) for p in either.split("|")) for either in patterns)
