"""The folder of a training: settings, state, networks, tables, and a picture of the curves.

At the end: a folder of samples, for trainings elsewhere.
"""

import json
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias

from shiftsim.errors import CheckpointError, ConfigError, DataError, MissingExtraError, one_of
from shiftsim.files import atomic_write, write_text
from shiftsim.runs.config import Option, setting

if TYPE_CHECKING:
    from torch import Tensor

    from shiftsim.train.stream import Block

SETTINGS = "settings.json"
STATE = "state.pt"  # all that is needed to go on
INDEX = "index.json"  # of samples in files
# networks: after the last round, with the best score on the towns that are left out, after PPO
LATEST, BEST, REINFORCED = "latest.safetensors", "best.safetensors", "ppo.safetensors"
TAUS = (0.2, 0.3, 0.5)  # s, tried where none is given
REPORT_EVERY = 10.0  # s
BATCH, RATE = 64, 1e-3  # of CaRL: states of a step, highest learning rate

OnMessage = Callable[[str], None]  # gets a line that says how far a training is
Weights: TypeAlias = dict[str, "Tensor"]  # by their names in CaRL's checkpoint


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseSettings:
    """What every training depends on, and where it is written."""

    least: ClassVar[dict[str, int]] = {"seed": 0}  # of numbers
    # settings on which the result does not depend
    elsewhere: ClassVar[tuple[str, ...]] = ("out", "workers")

    out: Path = field(metadata={"option": Option("Folder for networks, curves and tables.")})
    store: str = setting("demo", "Store by name, path or URL.")
    split: str = setting("", "Split of the store; if empty, all that was not dropped.")
    seed: int = setting(0, "Of everything that is random.")

    def __post_init__(self) -> None:
        """Refuse numbers that make no training."""
        for name, least in self.least.items():
            if (value := getattr(self, name)) < least:
                raise ConfigError(f"{name} is {value!r}", hint=f"give {least} or more")

    @property
    def determining(self) -> dict[str, object]:
        """What the result depends on; not where it is written, nor by how many processes."""
        return {name: v for name, v in asdict(self).items() if name not in self.elsewhere}


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings(BaseSettings):
    """What a training of CaRL's network depends on, and where and how it is done."""

    least: ClassVar = {
        **dict.fromkeys(("rounds", "states", "samples", "tests", "workers"), 1),
        **dict.fromkeys(("tau", "seed", "ppo_samples"), 0),
    }
    elsewhere: ClassVar = ("out", "workers", "ppo_samples")
    planner: ClassVar = "carl"

    checkpoint: str = setting("", "Weights to begin with: a file, or shiftsim. Else from nothing.")
    device: str = setting("cpu", "cpu, cuda, cuda:N or auto.")
    workers: int = setting(2, "Processes that drive, threads that train.")
    rounds: int = setting(8, "Of collecting, training and testing.")
    states: int = setting(360_000, "Labelled states to collect in all, at least.")
    samples: int = setting(1_280_000, "States to train on, each time counted.")
    tau: float = setting(0.0, "Of the labels [s]; 0 to choose it.")
    tests: int = setting(40, "Scenarios that each round is tested on.")
    ppo_samples: int = setting(0, "Steps of PPO afterwards.")

    def __post_init__(self) -> None:
        """Refuse numbers that make no training."""
        BaseSettings.__post_init__(self)
        if not self.tau <= 2.0:
            raise ConfigError(f"tau is {self.tau!r}", hint="give seconds up to 2, or 0 to choose")

    @property
    def recipe(self) -> "Preset":
        """How much is learnt."""
        return Preset(self.samples, self.rounds, BATCH, RATE)

    def part(self, number: int) -> Path:
        """The states of a round."""
        return self.out / "states" / f"round-{number:02d}"


class Preset(NamedTuple):
    """How much is learnt, and how fast."""

    samples: int
    rounds: int
    batch: int
    rate: float  # highest learning rate
    published: bool = False  # the authors' schedule, by rounds, and the weights without a mean


PRESETS = {
    # two cores for 90 minutes; the rate is that of the authors for this batch, by the square root
    "laptop": Preset(150_000, 3, 32, 1e-3),
    "workstation": Preset(5_000_000, 10, 128, 1e-3),
    "paper": Preset(25_000_000, 25, 128, 1e-3, published=True),
}
# of a sample; presets have as many as take the same time
COSTS = {"plantf": 1.0, "pluto": 1.6, "diffusion-planner": 2.5}
_FOR = Option("Whose features: plantf, pluto or diffusion-planner.", ("--for",))


@dataclass(frozen=True, slots=True, kw_only=True)
class ImitationSettings(BaseSettings):
    """What a training from recordings depends on, and where and how it is done."""

    least: ClassVar = {"rounds": 0, "samples": 0, "batch": 0, "seed": 0, "tests": 1, "workers": 1}

    planner: str = "plantf"
    preset: str = setting("laptop", "laptop, workstation or paper.", choices=tuple(PRESETS))
    device: str = setting("cpu", "cpu, cuda, cuda:N or auto.")
    workers: int = setting(2, "Processes that make samples, and that drive.")
    rounds: int = setting(0, "Of training and testing. [of the preset]")
    samples: int = setting(0, "To train on, each time counted. [of the preset]")
    batch: int = setting(0, "Samples of a step. [of the preset]")
    tests: int = setting(40, "Scenarios that each round is tested on.")

    def __post_init__(self) -> None:
        """Refuse numbers that make no training, and other presets."""
        BaseSettings.__post_init__(self)
        one_of("preset", self.preset, PRESETS)

    @property
    def recipe(self) -> Preset:
        """The preset, with what is given in its place."""
        preset = PRESETS[self.preset]
        cost = 1.0 if preset.published else COSTS[self.planner]
        samples = self.samples or round(preset.samples / cost)
        rounds, batch = self.rounds or preset.rounds, self.batch or preset.batch
        return preset._replace(rounds=rounds, samples=samples, batch=batch)


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureSettings(BaseSettings):
    """What samples in files depend on, not how many; and where and how they are made."""

    least: ClassVar = dict.fromkeys(("seed", "workers", "samples"), 0)
    elsewhere: ClassVar = ("out", "workers", "samples")

    out: Path = field(metadata={"option": Option("Folder for the samples.")})
    planner: str = field(metadata={"option": _FOR})
    workers: int = setting(2, "Processes that make samples; 0 for none but this one.")
    samples: int = setting(0, "At least so many; 0 to take every scenario once.")

    def __post_init__(self) -> None:
        """Refuse other planners, and numbers that make no stream."""
        one_of("--for", self.planner, COSTS)
        BaseSettings.__post_init__(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrafficSettings(BaseSettings):
    """What a training of traffic depends on, and where it is written."""

    least: ClassVar = {"seed": 0, "rounds": 1, "scenarios": 1, "epochs": 1, "tests": 1}

    rounds: int = setting(5, "Of collecting and training.")
    scenarios: int = setting(150, "That each round collects from.")
    epochs: int = setting(8, "Of each round.")
    tests: int = setting(100, "Scenarios that the result is measured on.")


def prepare_folder(settings: BaseSettings, store: str, *, resume: bool) -> None:
    """Make the folder of a training on a store of this hash, or check that it is the same one."""
    place = settings.out / SETTINGS
    now = json.loads(json.dumps(settings.determining)) | {"store_hash": store}
    if not place.exists():
        make_folder(settings.out)
        write_text(place, json.dumps(now, indent=2) + "\n")
        return
    before = {"planner": "plantf"} | json.loads(place.read_text("utf-8"))  # was the only one once
    for name in sorted(now, key=lambda name: (name in before, name)):
        if (old := before.get(name)) != now[name]:
            is_of = f"with {name} {old!r}, not {now[name]!r}"
            is_of = is_of if name in before else f"by another recipe, without {name}"
            what = f"{str(place)!r} is of a training {is_of}"
            raise ConfigError(what, hint="choose another --out")
    if not resume:
        what = f"{str(settings.out)!r} holds a training already"
        raise ConfigError(what, hint="go on with --resume, or choose another --out")


def make_folder(path: Path) -> None:
    """Make an empty folder; a ConfigError if it is there and not empty."""
    if path.exists() and any(path.iterdir()):
        raise ConfigError(f"{str(path)!r} is not empty", hint="choose another --out")
    path.mkdir(parents=True, exist_ok=True)


def read_state(path: Path) -> dict[str, Any]:
    """What a training needs to go on; a CheckpointError if the file is damaged."""
    import torch

    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        what = f"{str(path)!r} cannot be read: {error}"
        raise CheckpointError(what, hint="delete it to begin again") from error
    return state


def write_state(path: Path, state: dict[str, Any]) -> None:
    """Keep what a training needs to go on."""
    import torch

    with atomic_write(path) as partial:
        torch.save(state, partial)


def write_network(path: Path, weights: Weights, planner: str = "carl") -> None:
    """Write a network as `--checkpoint PLANNER=PATH` reads it."""
    from shiftsim.planners.learned.checkpoint import network_module

    tensors = {name: value.detach().cpu().contiguous() for name, value in weights.items()}
    args = getattr(network_module(planner), "DEFAULT_ARGS", None)
    # one entry only: several have no order
    known = {"args": json.dumps(args)} if args else {"planner": planner}
    write_tensors(path, tensors, known)


def write_tensors(path: Path, tensors: "dict[str, Tensor]", known: dict[str, str]) -> None:
    """Write a safetensors file with what is known of it."""
    from safetensors.torch import save

    with atomic_write(path) as partial:  # its own `save_file` lets nobody else read the file
        partial.write_bytes(save(tensors, known))


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows as Parquet."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    with atomic_write(path) as partial:
        pq.write_table(pa.Table.from_pylist(rows), partial)


TERMS = {  # by planner: what its curve has beside the loss, of which three are drawn, times what
    "carl": {"acceleration_error": 1.0, "steering_error": 10.0},
    "plantf": {"reg_loss": 1.0, "prediction_loss": 1.0, "cls_loss": 1.0},
    "pluto": {"reg_loss": 1.0, "prediction_loss": 1.0, "cls_loss": 1.0, "ref_free_reg_loss": 1.0},
    "diffusion-planner": {"ego_planning_loss": 1.0, "neighbor_prediction_loss": 1.0},
}


def draw_curves(
    path: Path, curve: list[dict[str, Any]], scores: list[dict[str, Any]], planner: str = "carl"
) -> None:
    """Draw errors while training, and scores after each round; nothing without matplotlib."""
    from shiftsim.report.palette import dashes, new_figure, planner_styles, save_picture

    errors = [name for name in scores[-1] if name.startswith("ADE")] if scores else []
    try:
        figure = new_figure(figsize=(8.0 if not errors else 10.5, 3.2))
    except MissingExtraError:
        return
    left, right, *more = figure.subplots(1, 3 if errors else 2)
    samples = [row["samples"] / 1e6 for row in curve]
    for (name, factor), colour in zip(TERMS[planner].items(), ("0.15", "0.6", "0.8"), strict=False):
        label = name.replace("_", " ") + (f" × {factor:g}" if factor != 1.0 else "")
        values = [factor * row[name] for row in curve]
        left.plot(samples, values, label=label, color=colour, linewidth=0.9)
    what = "mean absolute error" if planner == "carl" else "loss"
    left.set(xlabel="samples [million]", ylabel=what, yscale="log")
    left.legend(frameon=False, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    at = [row["samples"] / 1e6 for row in scores]
    style = planner_styles([planner])[planner]
    for noise in ("none", "ou-high"):
        look = {"label": f"noise {noise}", "linestyle": dashes(noise), **style.marks(noise)}
        right.plot(at, [100.0 * row[noise] for row in scores], **look)
    right.set(xlabel="samples [million]", ylabel="closed-loop score × 100", ylim=(0, 100))
    right.set_title("on towns left out", fontsize=9)
    right.legend(frameon=False)
    for axes in more:
        for name in errors:
            label = name.removeprefix("ADE of ").removesuffix(" [m]")
            look = {"linestyle": "-" if planner in name else ":", "marker": "o", "color": "0.15"}
            axes.plot(at, [row[name] for row in scores], label=label, **look)
        axes.set(xlabel="samples [million]", ylabel="open loop: ADE [m]")
        axes.set_ylim(0.0, 1.1 * axes.get_ylim()[1])
        axes.legend(frameon=False)
    save_picture(figure, path)


def write_features(settings: FeatureSettings, on_message: OnMessage) -> dict[str, Any]:
    """Write samples as a stream has them, a file for each of its blocks; returns the index of them.

    Files that are there are not made again, so that it goes on where it was ended. It is a
    DataError if no sample can be made.
    """
    from safetensors import safe_open

    from shiftsim.data import open_store
    from shiftsim.runs.scenarios import usable_tokens
    from shiftsim.train.stream import Stream, load_blocks

    store = open_store(settings.store)
    tokens = tuple(sorted(usable_tokens(store, settings.split)))
    prepare_folder(settings, store.hash, resume=True)
    which = settings.store, tokens, settings.seed, sys.maxsize, settings.planner
    stream = Stream(*which, as_published=True)
    files: dict[str, int] = {}  # samples of each
    failed, blocks, reported = Counter[str](), None, monotonic()
    for number in count():
        total = sum(files.values())
        if number == stream.blocks and not total:
            raise DataError("no sample could be made", hint=f"{dict(failed) or 'no scenarios'}")
        if total >= settings.samples if settings.samples else number == stream.blocks:
            break
        path = settings.out / f"samples-{number:06d}.safetensors"
        if blocks is None and not path.exists():
            blocks = load_blocks(stream, number, settings.workers)
        if blocks is not None:
            _write_block(path, next(blocks))
        with safe_open(path, "pt") as file:
            made = json.loads(file.metadata()["made"])
        files[path.name] = made["samples"]
        failed.update(made["failed"])
        if monotonic() - reported > REPORT_EVERY:
            reported = monotonic()
            on_message(f"{total + files[path.name]} samples in {len(files)} files")
    found = {"samples": total, "failed": dict(failed), "files": files}
    index = {**settings.determining, "store_hash": store.hash, **found}
    write_text(settings.out / INDEX, json.dumps(index, indent=2) + "\n")
    return index


def _write_block(path: Path, block: "Block") -> None:
    """Write all samples of a block, whose only batch they are."""
    tensors = block.batches[0].tensors() if block.batches else {}
    made = {"samples": len(tensors.get("target", ())), "failed": block.failed}
    write_tensors(path, tensors, {"made": json.dumps(made)})  # several entries have no order
