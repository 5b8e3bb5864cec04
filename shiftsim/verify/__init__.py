"""Compare shiftsim with a folder of reference outputs, recognised by its content.

Every part fills a `Report`; nothing here decides what is equal but the tolerances of the folders'
READMEs and of the project's own promise, whichever is tighter.
"""

from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from shiftsim.errors import DataError
from shiftsim.verify.report import Report

MODES = ("NR", "R", "PT")


class Kind(NamedTuple):
    """One kind of reference folder.

    Attributes:
        name: What it is called.
        signature: Glob patterns; the folder is of this kind when all of them match something,
            where `a|b` stands for either.
        function: `module:function` below `shiftsim.verify`, called with folder and report.
        takes: Which of `mode`, `scenes` and `maps` it takes besides.
    """

    name: str
    signature: tuple[str, ...]
    function: str
    takes: tuple[str, ...] = ()

    def matches(self, folder: Path) -> bool:
        """Whether a folder is of this kind."""
        return all(
            any(any(folder.glob(pattern)) for pattern in either.split("|"))
            for either in self.signature
        )


KINDS = (
    Kind("nuplan", ("scenes.json", "expected/*.parquet"), "nuplan:verify_nuplan", ("mode",)),
    Kind("nuplan_format", ("devkit_readback.json",), "nuplan.format:verify_nuplan_format"),
    Kind("metric_worlds", ("metric_world_*.json",), "metric_worlds:verify_metric_worlds"),
    Kind(
        "pdm",
        ("kernels/*.npz|kernels/*.json|routes.json|idm_calls.json|loop/steps.parquet",),
        "pdm:verify_pdm",
        ("mode", "scenes"),
    ),
    Kind(
        "nets",
        (
            "state_dict.json|route_correction_*.json|plantf|pluto|diffusion_planner|carl|"
            "route_correction",
        ),
        "nets:verify_nets",
        ("scenes",),
    ),
    Kind(
        "dynamics",
        (
            "bicycle_*.npz|lqr_commands.npz|closed_loop*.npz|idm_*|comfort_*.npz|ego_*.npz|traj*.npz",
        ),
        "dynamics:verify_dynamics",
    ),
    Kind("dsc3d_sample", ("expected_rows.parquet", "data"), "dsc3d:verify_dsc3d_sample"),
    Kind(
        "dsc3d_synthetic",
        ("**/expected_ego_20hz.parquet",),
        "dsc3d:verify_dsc3d_synthetic",
        ("maps",),
    ),
    Kind("opendrive", ("*.refline.parquet",), "opendrive:verify_opendrive", ("maps",)),
)


def verify(
    folder: Path, *, mode: str | None = None, scenes: Path | None = None, maps: Path | None = None
) -> Report:
    """Compare everything in a reference folder with what shiftsim computes.

    Args:
        folder: Reference folder.
        mode: Only runs of this challenge (`NR`, `R` or `PT`); None for all.
        scenes: Folder with the logs and maps that other folders refer to; by default a folder
            `nuplan` beside `folder`.
        maps: Folder with OpenDRIVE maps; by default a folder `maps` beside the parent of `folder`.

    Returns:
        The report.

    Raises:
        DataError: The folder is of no known kind, or a file in it is broken.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    options = {"mode": mode, "scenes": scenes, "maps": maps}
    for kind in KINDS:
        if kind.matches(folder):
            module, _, function = kind.function.partition(":")
            part = getattr(import_module(f"shiftsim.verify.{module}"), function)
            report = Report()
            part(folder, report, **{name: options[name] for name in kind.takes})
            return report
    raise DataError(
        f"{folder}: not recognised as a folder of reference outputs",
        hint=f"known kinds: {', '.join(kind.name for kind in KINDS)}",
    )
