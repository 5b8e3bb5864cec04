"""Settings of a training, and what its folder holds."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from shiftsim.errors import ConfigError
from shiftsim.files import write_text

SETTINGS = "settings.json"
TAUS = (0.2, 0.3, 0.5)  # s, tried where none is given


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
