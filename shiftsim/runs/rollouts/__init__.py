"""Rollouts on disk, and the task that names one.

`files` says what a row holds and how many rollouts share files; `branches` drives others from one.
"""

from typing import NamedTuple


class Task(NamedTuple):
    """One rollout to be made; also its key in every table, and the order of their rows."""

    planner: str  # planner name as in tables
    noise: str  # noise name
    seed: int  # seed of the noise; 0 without noise
    token: str  # scenario


def describe(task: Task) -> str:
    """A task in words."""
    seed = "" if task.noise == "none" else f" seed {task.seed}"
    return f"{task.planner} {task.noise}{seed} {task.token}"
