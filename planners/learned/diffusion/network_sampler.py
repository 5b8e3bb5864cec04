"""The sampler of the Diffusion Planner: DPM-Solver++ of order 2 in 10 steps.

Data prediction, multistep, uniform in log-SNR, for the linear variance-preserving schedule; the
network is called once more at the end. With
`log alpha(t) = -(b1 - b0) t^2 / 4 - b0 t / 2`, `sigma^2 = 1 - alpha^2` and
`lambda = log(alpha / sigma)`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

BETA_0, BETA_1 = 0.1, 20.0
FIRST_TIME, LAST_TIME = 1.0, 0.001
STEPS = 10
TEMPERATURE = 0.5  # of the start noise
STATE = 4  # x, y, cos, sin


@dataclass(frozen=True, slots=True)
class Schedule:
    """Numbers of the sampler; S steps, from time i to time i + 1."""

    times: Tensor  # (S + 1,) times from 1 to about 0.001
    log_alpha: Tensor  # (S + 1,) logarithm of `alpha`
    alpha: Tensor  # (S + 1,) factor of the data at each time
    sigma: Tensor  # (S + 1,) factor of the noise at each time
    half_snr: Tensor  # (S + 1,) lambda, half the logarithm of the signal-to-noise ratio
    h: Tensor  # (S,) lambda of the next time minus lambda of this one
    c_x: Tensor  # (S,) factor of the state in a step
    c_x0: Tensor  # (S,) factor of the predicted data in a step
    r0: Tensor  # (S - 1,) h of a step over that of the next one

    @property
    def call_times(self) -> Tensor:
        """(S + 1,) times of the network's calls: before each step, and at the end."""
        return torch.cat([self.times[:-1], torch.tensor([LAST_TIME])])


def make_schedule() -> Schedule:
    """The schedule of the official planner.

    All of it is computed in single precision (nuPlan rule 340): near time 0, where alpha is about
    1, that moves lambda by 1e-4, and with it the times at which the network is called.
    """
    ends = _half_snr(log_alpha_at(torch.tensor([FIRST_TIME, LAST_TIME])))
    wanted = torch.linspace(float(ends[0]), float(ends[1]), STEPS + 1)
    slope = 2.0 * (BETA_1 - BETA_0) * torch.logaddexp(-2.0 * wanted, torch.zeros(()))
    times = slope / (torch.sqrt(BETA_0**2 + slope) + BETA_0) / (BETA_1 - BETA_0)
    log_alpha = log_alpha_at(times)
    alpha = torch.exp(log_alpha)
    sigma = torch.sqrt(1.0 - torch.exp(2.0 * log_alpha))
    half_snr = _half_snr(log_alpha)
    h = half_snr.diff()
    c_x, c_x0, r0 = sigma[1:] / sigma[:-1], -alpha[1:] * torch.expm1(-h), h[:-1] / h[1:]
    return Schedule(times, log_alpha, alpha, sigma, half_snr, h, c_x, c_x0, r0)


def log_alpha_at(time: Tensor) -> Tensor:
    """Logarithm of the factor of the data at times."""
    return -0.25 * time**2 * (BETA_1 - BETA_0) - 0.5 * time * BETA_0


def _half_snr(log_alpha: Tensor) -> Tensor:
    return log_alpha - 0.5 * torch.log(1.0 - torch.exp(2.0 * log_alpha))


SCHEDULE = make_schedule()


def sample(network: Callable[[Tensor, int], Tensor], current: Tensor, noise: Tensor) -> Tensor:
    """(B, A, T, 4) normalised states from noise (B, A, T - 1, 4), the present ones (B, A, 4) first.

    `network` gives clean trajectories of noisy ones (B, A, 4 * T) and the number of the call.
    """
    x = torch.cat([current[:, :, None], TEMPERATURE * noise], dim=2).flatten(2)
    before = x
    for step in range(STEPS):
        clean = network(x, step)
        if step == 0:
            data = clean
        else:
            data = clean + float(0.5 / SCHEDULE.r0[step - 1]) * (clean - before)
        before = clean
        x = float(SCHEDULE.c_x[step]) * x + float(SCHEDULE.c_x0[step]) * data
        x[..., :STATE] = current
    x = network(x, STEPS).clone()
    x[..., :STATE] = current
    return x.view(*x.shape[:-1], -1, STATE)
