"""Models of what a planner sees, where it believes to be, and when its plan arrives.

A drift has one of each, and the actuation noise; its name is what runs, tables and pictures call
it. `sensing` applies it.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import chain, product
from math import inf, isfinite, log, radians
from typing import Any

import numpy as np

from shiftsim.errors import ConfigError, one_of
from shiftsim.files import load_attribute
from shiftsim.kernels import FloatArray
from shiftsim.sim.noise import NOISE_NAMES, NoiseModel, parse_noise

DT = 0.1  # s, nominal time between rows
DT_MS = 100
LEVELS = ("low", "mid", "high")

_LEVELS: dict[str, dict[str, tuple[float, ...]]] = {  # fields of models at `LEVELS`, by kind
    "perception": {
        "position": (0.1, 0.3, 0.5),
        "heading": (radians(1.0), radians(3.0), radians(5.0)),
        "velocity": (0.2, 0.5, 1.0),
        "size": (0.02, 0.05, 0.1),
    },
    "miss": {"missed": (0.02, 0.1, 0.2), "gap": (0.3, 0.5, 1.0)},
    # one of 20, 10, 5 tracks in 15 s
    "dropout": {"lost": (1 / 300, 1 / 150, 1 / 75), "lost_for": (1.0, 2.0, 4.0)},
    "localization": {
        "position": (0.05, 0.15, 0.3),
        "heading": (radians(0.2), radians(0.5), radians(1.0)),
    },
}
_AXES = (*_LEVELS, "range", "latency")  # in the order of tables, behind actuation noise
_HINT = "give module:attribute of a function, NoiseModel, Perception or Localization"


@dataclass(frozen=True, slots=True)
class Perception:
    """How the boxes that a planner sees differ from those that are there.

    Errors are stated at a distance of 20 m.

    Attributes:
        position: Standard deviation of the error of x and of y [m].
        heading: Of the heading [rad].
        velocity: Of both components of the velocity [m/s].
        size: Of length and width, which are wrong alike, as a share of them.
        tau: Time in which these errors decay to 1/e [s].
        missed: Share of detections that are missed, twice as many beyond 50 m.
        gap: Mean time for which a track is missed [s].
        lost: How often a track is lost, to return under a new token [1/s].
        lost_for: For how long [s].
        range: Distance up to which boxes are seen [m].
        name: As in tables and on the command line; derived from the values when empty.

    Example:
        ```python
        blurred = shiftsim.Perception(position=1.0, missed=0.1, name="blurred")
        scenario = shiftsim.open_store("demo")["01f13e"]
        log = shiftsim.simulate(scenario, "idm", perception=blurred, seed=3)
        print(log.seen.tracks.poses[0, 0] - log.tracks.poses[0, 0])
        ```
    """

    position: float = 0.0
    heading: float = 0.0
    velocity: float = 0.0
    size: float = 0.0
    tau: float = -DT / log(0.9)
    missed: float = 0.0
    gap: float = 0.5
    lost: float = 0.0
    lost_for: float = 2.0
    range: float = inf
    name: str = ""

    def __post_init__(self) -> None:
        bounds = {"tau": (DT, inf), "missed": (0.0, 0.25), "gap": (DT, inf), "lost_for": (DT, inf)}
        _check(self, bounds | {"lost": (0.0, 1.0 / DT)})

    @property
    def sigmas(self) -> FloatArray:
        """(6,) deviations of x, y, heading, velocity x, y, and size."""
        at, of = self.position, self.velocity
        return np.array([at, at, self.heading, of, of, self.size])

    @property
    def acts(self) -> bool:
        """Whether anything is seen otherwise than it is."""
        return bool(self.sigmas.any() or self.missed or self.lost or isfinite(self.range))


@dataclass(frozen=True, slots=True)
class Localization:
    """How the pose that a planner takes for its own differs from the true one.

    Attributes:
        position: Standard deviation of the error of x and of y [m].
        heading: Of the heading [rad].
        tau: Time in which the error decays to 1/e [s].
        name: As in tables and on the command line; derived from the values when empty.

    Example:
        ```python
        lost = shiftsim.Localization(position=1.0, heading=0.02, name="lost")
        log = shiftsim.simulate(shiftsim.open_store("demo")["01f13e"], "idm", localization=lost)
        ```
    """

    position: float = 0.0
    heading: float = 0.0
    tau: float = 3.0
    name: str = ""

    def __post_init__(self) -> None:
        _check(self, {"tau": (DT, inf)})

    @property
    def acts(self) -> bool:
        """Whether the pose is another than the true one."""
        return bool(self.position or self.heading)


def _check(model: Perception | Localization, bounds: dict[str, tuple[float, float]]) -> None:
    """Refuse values out of their bounds, and derive the name where it is empty."""
    kind, values = type(model).__name__.lower(), list[str]()
    for item in fields(model)[:-1]:
        value, (low, high) = getattr(model, item.name), bounds.get(item.name, (0.0, inf))
        if not low <= value <= high:
            raise ConfigError(f"{kind} {item.name} is {value!r}; it must be {low:g} to {high:g}")
        values += [f"{item.name}={value:g}"] if value != item.default else []
    if not model.name:
        object.__setattr__(model, "name", f"{kind}({','.join(values)})" if values else "none")


@dataclass(frozen=True, slots=True)
class Drift:
    """What differs from a perfect vehicle: actuation, perception, localization, latency."""

    noise: NoiseModel = field(default_factory=NoiseModel)
    perception: Perception = field(default_factory=Perception)
    localization: Localization = field(default_factory=Localization)
    latency: int = 0  # of plans [ms]

    def __post_init__(self) -> None:
        if self.latency < 0 or self.latency % DT_MS:
            raise ConfigError(
                f"latency {self.latency!r} is not a multiple of {DT_MS} ms",
                hint="plans arrive at a step of the simulation: 0, 100, 200, …",
            )

    @property
    def name(self) -> str:
        """As in tables: the names of what acts, joined by `+`, or none."""
        late = f"latency-{self.latency}" if self.latency else "none"
        names = (self.noise.name, self.perception.name, self.localization.name, late)
        return "+".join(name for name in names if name != "none") or "none"

    @property
    def senses(self) -> bool:
        """Whether a planner sees anything otherwise than it is."""
        return self.perception.acts or self.localization.acts

    @property
    def is_random(self) -> bool:
        """Whether rollouts differ from seed to seed."""
        return self.noise.kind != "none" or self.senses

    def fingerprint(self) -> dict[str, Any]:
        """What rollouts depend on, as JSON values; of noise alone what it always was."""
        names = ("kind", "sigma_accel", "sigma_rate", "theta")
        out: dict[str, Any] = {name: getattr(self.noise, name) for name in names}
        out["function"] = None if self.noise.function is None else self.noise.name
        if self.senses and self.noise.kind == "none":
            out["kind"] = "sensing"  # has seeds
        for name, model in (("perception", self.perception), ("localization", self.localization)):
            finite = {key: value for key, value in asdict(model).items() if value != inf}
            out |= {name: finite} if model.acts else {}
        return out | ({"latency": self.latency} if self.latency else {})


def parse_drift(name: str) -> Drift:
    """The drift of a name.

    Args:
        name: Names joined by `+`: those of `NOISE_NAMES`; `perception-`, `miss-`, `dropout-` and
            `localization-` with `low`, `mid` or `high`; `range-METRES`; `latency-MS`; and
            `module:attribute` of a noise function or of a model.

    Raises:
        ConfigError: A name is unknown, or there are two of a kind.
    """
    found, given = Drift(), dict[str, str]()
    for part in filter(lambda part: part != "none", name.split("+")):
        kind = part.partition("-")[0]
        if kind not in _AXES:
            model: Any = load_attribute("noise", part, _HINT) if ":" in part else None
            if not isinstance(model, (Perception, Localization)):
                model = parse_noise(part)
            kind = _axis(model)
            found = replace(found, **{kind: model})
        elif kind == "latency":
            found = replace(found, **_values(part))
        else:
            axis = kind if kind == "localization" else "perception"
            before = getattr(found, axis)
            joined = part if before.name == "none" else f"{before.name}+{part}"
            found = replace(found, **{axis: replace(before, **_values(part), name=joined)})
        if kind in given:
            raise ConfigError(
                f"{given[kind]!r} and {part!r} are two of a kind in one drift",
                hint=f"join one each of noise, {', '.join(_AXES)}; drive others one by one",
            )
        given[kind] = part
    return found


def _values(part: str) -> dict[str, Any]:
    """Fields of a model that a name stands for, such as `miss-low` or `range-60`."""
    kind, _, level = part.partition("-")
    if kind in _LEVELS:
        others = ", or miss-, dropout- with these, range-METRES" if kind == "perception" else ""
        number = LEVELS.index(one_of(kind, level, LEVELS, others))
        return {field: values[number] for field, values in _LEVELS[kind].items()}
    if not level.isdecimal():
        what = f"{kind} {level!r} is not a whole number, 0 or more"
        raise ConfigError(what, hint="of milliseconds in latency-200, of metres in range-60")
    return {kind: int(level) if kind == "latency" else float(level)}


def _axis(model: NoiseModel | Perception | Localization) -> str:
    return "noise" if isinstance(model, NoiseModel) else type(model).__name__.lower()


def make_drift(
    noise: Any = "none", perception: Any = "none", localization: Any = "none", latency: int = 0
) -> Drift:
    """A drift of names or models; noise may be the name of a drift, or a drift.

    Perception takes `low`, `mid` and `high` for `perception-low`, and so on.

    Raises:
        ConfigError: A name is unknown, or there are two of a kind.
    """
    names, models = [f"latency-{latency}"] if latency else ["none"], list[Any]()
    given = {"": noise, "perception": perception, "localization": localization}
    for kind, one in given.items():
        if isinstance(one, str):
            for part in one.split("+"):
                is_whole = part == "none" or ":" in part or part.partition("-")[0] in _AXES
                names += [part if is_whole or not kind else f"{kind}-{part}"]
        elif isinstance(one, (Drift, NoiseModel, Perception, Localization)):
            models.append(one)
        else:
            what = f"{kind or 'noise'} {one!r} is no name or model"
            raise ConfigError(what, hint="give one; `run` and `bench` take lists of them")
    found = parse_drift("+".join(names))
    for model in models:
        found = model if isinstance(model, Drift) else replace(found, **{_axis(model): model})
    return found


def make_drifts(noise: Any, perception: Any, localization: Any, latency: Any) -> list[Drift]:
    """Every combination of what may be lists, each once; the noise `all` is all its names."""
    given = (noise, perception, localization, latency)
    noises, *others = ([*one] if isinstance(one, (list, tuple)) else [one] for one in given)
    named = [NOISE_NAMES if isinstance(one, str) and one == "all" else [one] for one in noises]
    found = [make_drift(*one) for one in product(chain(*named), *others)]
    return list({one.name: one for one in found}.values())


def noise_of(name: str) -> str:
    """The actuation noise in the name of a drift, of those of `NOISE_NAMES`."""
    return next((part for part in name.split("+") if part in NOISE_NAMES), "none")


def has_seeds(name: str) -> bool:
    """Whether rollouts under the drift of a name differ from seed to seed."""
    return any(part != "none" and not part.startswith("latency-") for part in name.split("+"))


def drift_order(names: Iterable[str]) -> list[str]:
    """Drifts, each once: none, noise, others by kind from low to high, then custom ones by name."""
    return sorted(set(names), key=lambda name: [_rank(part) for part in name.split("+")])


def _rank(part: str) -> tuple[int, float, str]:
    if part in NOISE_NAMES:
        return 0, NOISE_NAMES.index(part), ""
    kind, _, level = part.partition("-")
    if kind not in _AXES:
        return 1 + len(_AXES), 0.0, part
    number = float(level) if level.isdecimal() else LEVELS.index(level) if level in LEVELS else inf
    return 1 + _AXES.index(kind), number, part
