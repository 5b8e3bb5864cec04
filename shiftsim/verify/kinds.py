"""The kinds of reference folders, how each is recognised, and who compares it."""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from shiftsim.verify.report import Report


@dataclass(frozen=True)
class Kind:
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

    def verify(self, folder: Path, report: Report, **options: object) -> None:
        """Compare the folder; `options` are `mode`, `scenes` and `maps`."""
        module, _, function = self.function.partition(":")
        taken = {name: options[name] for name in self.takes}
        getattr(import_module(f"shiftsim.verify.{module}"), function)(folder, report, **taken)


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
