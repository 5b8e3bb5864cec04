"""Actuation noise: what is added to the command between tracker and motion model.

White noise (`awgn`) is sigma times a standard normal at every step. The Ornstein-Uhlenbeck process
(`ou`) starts at 0 and is updated before it is applied: x += theta (0 - x) dt + sigma sqrt(dt) eps.
"""

import hashlib
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from shiftsim.errors import ConfigError, one_of
from shiftsim.files import load_attribute
from shiftsim.kernels import FloatArray

CHANNELS = ("noise-accel", "noise-steer")
NOISE_NAMES = ("none", "awgn-low", "awgn-mid", "awgn-high", "ou-low", "ou-mid", "ou-high")
SIGMA_BY_LEVEL = {  # acceleration [m/s^2], steering rate [rad/s]; of the state-drift benchmark
    "low": (0.5, 0.1),
    "mid": (1.0, 0.2),
    "high": (1.5, 0.3),
}
OU_THETA = 2.0  # 1/s, of the state-drift benchmark


class NoiseFunction(Protocol):
    """A custom noise model: any callable with this signature, named `module:attribute`."""

    def __call__(
        self, accel: np.random.Generator, steering: np.random.Generator, num_steps: int, dt: float
    ) -> FloatArray:
        """Noise of a whole rollout.

        Args:
            accel: Random numbers of the acceleration channel.
            steering: Random numbers of the steering-rate channel.
            num_steps: T, number of steps.
            dt: Nominal step [s].

        Returns:
            (T, 2) added to the acceleration [m/s^2] and to the steering rate [rad/s].
        """


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Kind and strength of the actuation noise.

    Attributes:
        kind: "none", "awgn", "ou" or "custom".
        sigma_accel: Of the acceleration; for `ou` per square root of a second [m/s^2].
        sigma_rate: Of the steering rate; for `ou` per square root of a second [rad/s].
        theta: Rate of return to zero of `ou` [1/s].
        function: The model of kind "custom".
        name: As in tables and on the command line; derived from the parameters when empty.

    Example:
        ```python
        rough = shiftsim.NoiseModel("ou", sigma_accel=1.0, sigma_rate=0.2, name="rough")
        scenario = shiftsim.open_store("demo")["01f13e"]
        log = shiftsim.simulate(scenario, "idm", noise=rough, seed=3)
        ```
    """

    kind: str = "none"
    sigma_accel: float = 0.0
    sigma_rate: float = 0.0
    theta: float = OU_THETA
    function: NoiseFunction | None = None
    name: str = ""

    def __post_init__(self) -> None:
        one_of("noise kind", self.kind, ("none", "awgn", "ou", "custom"))
        for field in ("sigma_accel", "sigma_rate", "theta"):
            value = getattr(self, field)
            if not (np.isfinite(value) and value >= 0.0):
                raise ConfigError(f"noise {field} is {value!r}", "give a finite number, 0 or more")
        if (self.kind == "custom") != (self.function is not None):
            raise ConfigError(
                f"noise kind {self.kind!r} with function {self.function!r}",
                "give a function with kind 'custom', and only then",
            )
        if self.name:
            return
        name = self.kind
        if (owner := self.function) is not None:
            label = getattr(owner, "__qualname__", type(owner).__qualname__)
            name = f"{owner.__module__}:{label}"
        elif name != "none":
            theta = f",{self.theta:g}" if name == "ou" else ""
            name += f"({self.sigma_accel:g},{self.sigma_rate:g}{theta})"
        object.__setattr__(self, "name", name)


def parse_noise(name: str) -> NoiseModel:
    """The noise model of a name.

    Args:
        name: One of `NOISE_NAMES`, or `module:attribute` of a custom model: a `NoiseFunction` or a
            `NoiseModel`.

    Raises:
        ConfigError: The name is unknown, or the custom model cannot be imported.
    """
    if ":" in name:
        hint = "give module:attribute of a function or NoiseModel on the Python path"
        found = load_attribute("noise", name, hint)
        if isinstance(found, NoiseModel):
            return found
        if not callable(found):
            raise ConfigError(
                f"noise {name!r} is {type(found).__name__}, not callable",
                "see shiftsim.sim.noise.NoiseFunction for the signature",
            )
        return NoiseModel("custom", function=found, name=name)
    one_of("noise", name, (*NOISE_NAMES, "module:attribute"))
    if name == "none":
        return NoiseModel()
    kind, level = name.split("-")
    accel, rate = SIGMA_BY_LEVEL[level]
    return NoiseModel(kind, accel, rate, name=name)


def is_standard(model: NoiseModel) -> bool:
    """Whether the name of a model says all of it, to everybody and for ever."""
    return model.name in NOISE_NAMES and model == parse_noise(model.name)


def sample_noise(
    model: NoiseModel | str, *, seed: int, token: str, num_steps: int, dt: float = 0.1
) -> FloatArray:
    """The noise of a whole rollout of T steps, `dt` [s] long each.

    Returns:
        (T, 2) added to the acceleration [m/s^2] and to the steering rate [rad/s]; exactly 0 where
        sigma is 0.

    Raises:
        ConfigError: The name is unknown, or a custom model returned something else than (T, 2)
            finite numbers.
    """
    if isinstance(model, str):
        model = parse_noise(model)
    if model.kind == "none":
        return np.zeros((num_steps, 2))
    accel, steering = (keyed_generator(seed, token, channel) for channel in CHANNELS)
    if model.function is not None:
        noise = np.asarray(model.function(accel, steering, num_steps, dt), np.float64)
        if noise.shape != (num_steps, 2) or not np.isfinite(noise).all():
            raise ConfigError(
                f"noise {model.name!r} returned shape {noise.shape}, "
                f"{int(np.count_nonzero(~np.isfinite(noise)))} values not finite",
                f"return {num_steps} x 2 finite numbers: acceleration and steering rate",
            )
        return noise
    eps = np.stack([accel.standard_normal(num_steps), steering.standard_normal(num_steps)], axis=1)
    return noise_from_normals(model, eps, dt)


def noise_from_normals(model: NoiseModel, eps: FloatArray, dt: float = 0.1) -> FloatArray:
    """The noise (T, 2) that standard normals (T, 2) make, acceleration and steering rate."""
    out = np.zeros(eps.shape)
    for column, sigma in enumerate((model.sigma_accel, model.sigma_rate)):
        if sigma == 0.0 or model.kind == "none":
            continue  # not 0 * eps, which can be -0.0
        if model.kind != "ou":
            out[:, column] = sigma * eps[:, column]
            continue
        value, diffusion = 0.0, sigma * float(np.sqrt(dt))
        for row, normal in enumerate(eps[:, column].tolist()):  # 0 at first, updated, applied
            value = value + model.theta * (0.0 - value) * dt + diffusion * normal
            out[row, column] = value
    return out


def keyed_generator(seed: int, token: str, channel: str) -> np.random.Generator:
    """Random numbers that depend on nothing but seed, scenario token and channel name.

    So the same noise hits every planner, in any order of runs and on any number of workers.
    """
    key = int.from_bytes(channel_key(seed, token, channel), "little")
    return np.random.Generator(np.random.Philox(key=key))


def channel_key(seed: int, token: str, channel: str) -> bytes:
    """16 bytes that stand for seed, scenario token and channel name."""
    # nuPlan rule 14: the key is the BLAKE2b digest of the three, the generator is Philox
    text = f"{int(seed)}\n{token}\n{channel}"
    return hashlib.blake2b(text.encode(), digest_size=16).digest()
