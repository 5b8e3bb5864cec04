"""The folder of a training: settings, state, networks, tables, and a picture of the curves."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor

from shiftsim.errors import CheckpointError, ConfigError, MissingExtraError
from shiftsim.files import atomic_write, write_text
from shiftsim.report.palette import dashes, new_figure, planner_styles, save_picture

SETTINGS = "settings.json"
TAUS = (0.2, 0.3, 0.5)  # s, tried where none is given

OnMessage = Callable[[str], None]  # gets a line that says how far a training is
Weights = dict[str, Tensor]  # by their names in CaRL's checkpoint


@dataclass(frozen=True, slots=True)
class Settings:
    """What a training depends on, and where and how it is done."""

    store: str  # name, path or URL of the store
    out: Path  # folder that is written
    split: str = ""  # of the store; all scenarios if empty
    checkpoint: str = ""  # weights to begin with, as planners take them; from nothing if empty
    seed: int = 0
    rounds: int = 8  # of collecting, training and testing
    states: int = 360_000  # labelled states in all
    samples: int = 1_280_000  # states that the network is trained on in all, each time counted
    tau: float = 0.0  # of the labels [s]; 0 to choose it
    tests: int = 40  # scenarios that a round is tested on, of towns that are left out
    ppo_samples: int = 0  # of reinforcement learning afterwards
    device: str = "cpu"
    workers: int = 2  # processes that drive, and threads that train

    def __post_init__(self) -> None:
        """Refuse numbers that make no training."""
        for name in ("rounds", "states", "samples", "tests", "workers"):
            if getattr(self, name) < 1:
                value = getattr(self, name)
                raise ConfigError(f"{name} is {value!r}", hint="give a number above 0")
        if not 0.0 <= self.tau <= 2.0:
            raise ConfigError(f"tau is {self.tau!r}", hint="give seconds up to 2, or 0 to choose")
        if self.seed < 0 or self.ppo_samples < 0:
            raise ConfigError("seed or ppo_samples is negative", hint="give 0 or more")

    @property
    def determining(self) -> dict[str, object]:
        """What the result depends on; not where it is written, nor by how many processes."""
        left_out = ("out", "workers", "ppo_samples")
        return {name: value for name, value in asdict(self).items() if name not in left_out}

    @property
    def network(self) -> Path:
        """The network after the last round."""
        return self.out / "latest.safetensors"

    @property
    def best(self) -> Path:
        """The network with the best score on the towns that are left out."""
        return self.out / "best.safetensors"

    @property
    def reinforced(self) -> Path:
        """The network after PPO."""
        return self.out / "ppo.safetensors"

    @property
    def state(self) -> Path:
        """All that is needed to go on."""
        return self.out / "state.pt"

    def part(self, number: int) -> Path:
        """The states of a round."""
        return self.out / "states" / f"round-{number:02d}"


def prepare_folder(settings: Settings, store: str, *, resume: bool) -> None:
    """Make the folder of a training on a store of this hash, or check that it is the same one.

    Raises:
        ConfigError: There is one already, or another one.
    """
    place = settings.out / SETTINGS
    now = json.loads(json.dumps(settings.determining)) | {"store_hash": store}
    if place.exists():
        before = json.loads(place.read_text("utf-8"))
        differing = sorted(name for name in now if before.get(name) != now[name])
        if differing:
            name = differing[0]
            raise ConfigError(
                f"{str(place)!r} is of a training with {name} {before.get(name)!r}, "
                f"not {now[name]!r}",
                hint="choose another --out",
            )
        if not resume:
            raise ConfigError(
                f"{str(settings.out)!r} holds a training already",
                hint="go on with --resume, or choose another --out",
            )
        return
    if settings.out.exists() and any(settings.out.iterdir()):
        raise ConfigError(f"{str(settings.out)!r} is not empty", hint="choose another --out")
    settings.out.mkdir(parents=True, exist_ok=True)
    write_text(place, json.dumps(now, indent=2) + "\n")


def read_state(path: Path) -> dict[str, Any]:
    """What a training needs to go on.

    Raises:
        CheckpointError: The file is damaged.
    """
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise CheckpointError(
            f"{str(path)!r} cannot be read: {error}", hint="delete it to begin again"
        ) from error
    return state


def write_state(path: Path, state: dict[str, Any]) -> None:
    """Keep what a training needs to go on."""
    with atomic_write(path) as partial:
        torch.save(state, partial)


def write_network(path: Path, weights: Weights) -> None:
    """Write a network as `--checkpoint carl=PATH` reads it."""
    from safetensors.torch import save_file

    tensors = {name: value.detach().cpu().contiguous() for name, value in weights.items()}
    with atomic_write(path) as partial:
        save_file(tensors, partial, {"planner": "carl"})


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows as Parquet."""
    with atomic_write(path) as partial:
        pq.write_table(pa.Table.from_pylist(rows), partial)


def draw_curves(path: Path, curve: list[dict[str, Any]], scores: list[dict[str, Any]]) -> None:
    """Draw errors while training, and scores after each round; nothing without matplotlib."""
    try:
        figure = new_figure(figsize=(8.0, 3.2))
    except MissingExtraError:
        return
    left, right = figure.subplots(1, 2)
    samples = [row["samples"] / 1e6 for row in curve]
    for name, factor, colour in (("acceleration", 1.0, "0.15"), ("steering", 10.0, "0.6")):
        values = [factor * row[f"{name}_error"] for row in curve]
        label = f"{name} error" + (f" × {factor:g}" if factor != 1.0 else "")
        left.plot(samples, values, label=label, color=colour, linewidth=0.9)
    left.set(xlabel="samples [million]", ylabel="mean absolute error", yscale="log")
    left.legend(frameon=False, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    at = [row["samples"] / 1e6 for row in scores]
    style = planner_styles(["carl"])["carl"]
    for noise in ("none", "ou-high"):
        look = {"label": f"noise {noise}", "linestyle": dashes(noise), **style.marks(noise)}
        right.plot(at, [100.0 * row[noise] for row in scores], **look)
    right.set(xlabel="samples [million]", ylim=(0, 100))
    right.set_ylabel("closed-loop score × 100")
    right.set_title("on towns left out", fontsize=9)
    right.legend(frameon=False, loc="lower right")
    save_picture(figure, path)
