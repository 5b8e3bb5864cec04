"""The planners there are, by name; nothing of them is imported here."""

import importlib.util
import types
from dataclasses import dataclass
from pathlib import Path

from shiftsim.files import PACKAGE, checkpoint_folder


@dataclass(frozen=True, slots=True)
class Published:
    """A checkpoint as its authors publish it."""

    file: str  # what is published
    project: str  # name of the project that publishes it
    name: str  # file or folder in the folder of checkpoints, where it is found by itself
    megabytes: int  # of the weights; a file that holds more of the training is larger
    sha256: str = ""  # of the file, where it is known

    @property
    def place(self) -> Path:
        """Where it is found by itself."""
        return checkpoint_folder() / self.name

    def describe(self) -> str:
        """What it is and where it is from, in one line."""
        digest = f", SHA-256 {self.sha256}" if self.sha256 else ""
        return (
            f"{self.file} (weights of {self.megabytes} MB{digest}) from the project {self.project}"
        )


@dataclass(frozen=True, slots=True)
class PlannerEntry:
    """One registered planner."""

    name: str  # its name everywhere
    kind: str  # `rule-based`, `oracle` (looks at the recording), `replay` or `learned`
    target: str  # `package.module:Class`
    description: str  # one line
    arguments: tuple[str, ...] = ()  # names of the arguments it takes
    # what a learned planner loads; it also needs the extra `learned`
    checkpoint: Published | None = None


OFFICIAL, SHIPPED = "official", "shiftsim"  # words that stand for a checkpoint
SHIPPED_NOTE = "shiftsim's weights, trained on generated towns; not the paper's"
_HERE = "shiftsim.planners"
_NETWORK = ("checkpoint", "device")  # arguments of learned planners
_IDM = ("min_gap", "headway", "accel_max", "decel_max")
_ENTRIES = (
    PlannerEntry(
        "carl",
        "learned",
        f"{_HERE}.learned.carl.planner:Carl",
        "a policy trained by reinforcement learning on a raster of the surroundings",
        _NETWORK,
        Published(
            "nuPlan/checkpoints/nuplan_51892_1B/model_best.pth",
            "autonomousvision/CaRL",
            "nuplan_51892_1B",
            megabytes=8,
        ),
    ),
    PlannerEntry(
        "constant-velocity",
        "rule-based",
        f"{_HERE}.basic:ConstantVelocity",
        "keeps heading and speed",
    ),
    PlannerEntry(
        "diffusion-planner",
        "learned",
        f"{_HERE}.learned.diffusion.planner:DiffusionPlanner",
        "samples the future of ego and neighbours with a diffusion transformer",
        _NETWORK,
        Published(
            "model.pth and args.json",
            "ZhengYinan-AIR/Diffusion-Planner",
            "diffusion-planner",
            megabytes=24,
        ),
    ),
    PlannerEntry(
        "idm",
        "rule-based",
        f"{_HERE}.idm:Idm",
        "nuPlan's IDM planner: follows the route's lanes behind the nearest object",
        ("target_velocity", *_IDM),
    ),
    PlannerEntry("log-future", "oracle", f"{_HERE}.basic:LogFuture", "drives the recorded future"),
    PlannerEntry(
        "pdm-closed",
        "rule-based",
        f"{_HERE}.pdm.planner:PdmClosed",
        "drives 15 proposals along the route in its head and takes the best one",
        ("speed_fractions", "lateral_offsets", "fallback_velocity", *_IDM, "map_radius"),
    ),
    PlannerEntry(
        "plantf",
        "learned",
        f"{_HERE}.learned.plantf.planner:PlanTF",
        "imitation with a transformer over agents and map",
        _NETWORK,
        Published("planTF.ckpt", "jchengai/planTF", "planTF.ckpt", megabytes=8),
    ),
    PlannerEntry(
        "pluto",
        "learned",
        f"{_HERE}.learned.pluto.planner:Pluto",
        "imitation with contrastive learning, and a choice among its plans by rules",
        _NETWORK,
        Published("pluto_1M_aux_cil.ckpt", "jchengai/pluto", "pluto_1M_aux_cil.ckpt", megabytes=17),
    ),
    PlannerEntry(
        "scripted",
        "replay",
        f"{_HERE}.basic:Scripted",
        "replays pose sequences from a Parquet or CSV file",
        ("file", "name"),
    ),
    PlannerEntry(
        "simple",
        "rule-based",
        f"{_HERE}.basic:Simple",
        "nuPlan's SimplePlanner: straight on, slows down to a limit",
        ("max_velocity",),
    ),
)
PLANNERS = types.MappingProxyType({entry.name: entry for entry in _ENTRIES})
PUBLISHED = {entry.name: entry.checkpoint for entry in _ENTRIES if entry.checkpoint is not None}


def shipped_file(planner: str) -> Path | None:
    """Where our own weights of a planner are; None where there are none."""
    path = PACKAGE / "planners/learned" / planner / "shiftsim.safetensors"
    return path if path.is_file() else None


def readiness(entry: PlannerEntry) -> str:
    """What is missing to run a planner without further ado, in one line; empty where nothing."""
    if entry.checkpoint is None:
        return ""
    if importlib.util.find_spec("torch") is None:
        return "needs PyTorch: pip install 'shiftsim[learned]'"
    path = entry.checkpoint.place
    if path.exists() or shipped_file(entry.name) is not None:
        return ""
    return f"no checkpoint: give one, or put it at {path}"
