"""Checkpoint files as the authors' training code writes them, with made-up weights."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch

from shiftsim.planners.learned.checkpoint import load_weights

LEARNED = ("carl", "diffusion-planner", "plantf", "pluto")


class AttributeDict(dict):
    """A dictionary of a class that the reader does not know, as Lightning has one."""

    def __getattr__(self, name: str) -> Any:
        return self[name]


class Callback:
    """An object of training code."""

    def __init__(self) -> None:
        self.best = np.float64(0.25)
        self.weights = torch.ones(2)
        self.items = [self, {"me": self}]


class Hostile:
    """Makes a file when it is unpickled by a loader that trusts it."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return os.system, (f"touch {self.marker}",)


def state_of(planner: str) -> dict[str, torch.Tensor]:
    """Deterministic weights of a planner."""
    return load_weights("deterministic:base", planner, device="cpu").state


def lightning_entries(state: dict[str, torch.Tensor], prefix: str = "model.") -> dict[str, Any]:
    """What a Lightning file holds, with the entries that a restricted loader accepts."""
    return {
        "epoch": 24,
        "global_step": 1000,
        "pytorch-lightning_version": "1.9.0",
        "state_dict": {prefix + name: value for name, value in state.items()},
        "optimizer_states": [{"state": {0: {"exp_avg": torch.zeros(3)}}, "param_groups": []}],
        "hyper_parameters": {"lr": np.float64(1e-3), "epochs": np.int64(25), "dropout": None},
    }


def write_published(folder: Path, planner: str, state: dict[str, torch.Tensor]) -> Path:
    """A file with the container and the names of the published one."""
    folder.mkdir(parents=True, exist_ok=True)
    if planner == "diffusion-planner":
        return write_diffusion(folder, state)
    if planner == "carl":
        return save(state, folder / "model_best.pth")
    return save(lightning_entries(state), folder / f"{planner}.ckpt")


def write_diffusion(folder: Path, state: dict[str, torch.Tensor], prefix: str = "module.") -> Path:
    """Diffusion Planner's `model.pth` and `args.json`; its `model` entry is not the one to use."""
    average = {prefix + name: value for name, value in state.items()}
    raw = {name: torch.zeros_like(value) for name, value in average.items()}
    entries = {"epoch": 500, "model": raw, "ema_state_dict": average, "wandb_id": None, "loss": 1.5}
    (folder / "args.json").write_text(json.dumps(diffusion_args()))
    return save(entries, folder / "model.pth")


def diffusion_args() -> dict[str, Any]:
    """Settings of Diffusion Planner as its training writes them."""
    from shiftsim.planners.learned.diffusion.network import DEFAULT_ARGS

    return dict(DEFAULT_ARGS)


def save(entries: Any, path: Path, **options: Any) -> Path:
    """Write with torch."""
    torch.save(entries, path, **options)
    return path
