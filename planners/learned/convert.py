"""What is in a checkpoint file, and the same weights as a safetensors file."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shiftsim.errors import CheckpointError
from shiftsim.planners.learned import checkpoint
from shiftsim.planners.learned.checkpoint import require_torch


@dataclass(frozen=True, slots=True)
class Inspection:
    """What is in a checkpoint file."""

    path: str  # the file
    container: str  # kind of file, and the entry that holds the weights
    planner: str  # the planner that it looks like; empty for none
    problem: str  # why that planner cannot load it; empty where it can
    tensors: int  # number of tensors
    parameters: int  # number of values in them
    sha256: str  # of the file
    args: dict[str, Any] | None  # settings beside the weights, or None
    skipped: tuple[str, ...]  # what was left out
    made_from: str  # SHA-256 of the file that this one was converted from, or empty

    def lines(self) -> list[str]:
        """As text."""
        fits = f"no: {self.problem}" if self.problem else "yes"
        args = "none" if self.args is None else f"{len(self.args)} settings (--json shows them)"
        return [
            f"file        {self.path}",
            f"container   {self.container}",
            f"looks like  {self.planner or 'no planner known here'}",
            *([f"loads       {fits}"] if self.planner else []),
            f"tensors     {self.tensors}, {self.parameters} values",
            f"sha256      {self.sha256}",
            *([f"made from   sha256 {self.made_from}"] if self.made_from else []),
            f"args        {args}",
            f"left out    {', '.join(self.skipped) or 'nothing'}",
        ]


def inspect_checkpoint(spec: str) -> Inspection:
    """Look into a checkpoint: a file, a folder with one, or a name; or a CheckpointError."""
    require_torch("reading a checkpoint")
    found = checkpoint.open_checkpoint(checkpoint.find_checkpoint(spec))
    planner, problem = checkpoint.most_like(checkpoint.shapes_of(found.state)), ""
    if planner:
        try:
            checkpoint.checked_state(found, planner, checkpoint.needed_args(found, planner))
        except CheckpointError as error:
            problem = str(error)
    return Inspection(
        path=str(found.path),
        container=found.container,
        planner=planner,
        problem=problem,
        tensors=len(found.state),
        parameters=sum(tensor.numel() for tensor in found.state.values()),
        sha256=checkpoint.file_hash(found.path),
        args=found.args,
        skipped=found.skipped,
        made_from=found.made_from,
    )


def convert_checkpoint(spec: str, out: Path, *, half: bool = False) -> Inspection:
    """Write the weights that a planner loads, and nothing else, to a safetensors file.

    Its metadata names planner, args and the hash of the source. With `half` its numbers are
    float16, for half the size; planners compute with float32. Returns what is in the new file. It
    is a CheckpointError if the source is not complete, or of no planner known here.
    """
    require_torch("converting a checkpoint")
    from safetensors.torch import save_file

    if out.suffix != ".safetensors":
        raise CheckpointError(f"cannot write {str(out)!r}", hint="name it ….safetensors")
    found = checkpoint.open_checkpoint(checkpoint.find_checkpoint(spec))
    if out.exists() and out.samefile(found.path):
        raise CheckpointError(f"{str(out)!r} is the checkpoint itself", "write to another file")
    planner = checkpoint.most_like(checkpoint.shapes_of(found.state))
    if not planner:
        what = f"checkpoint {str(found.path)!r} is of no planner known here"
        raise CheckpointError(what, f"shiftsim checkpoint inspect {found.path}")
    args = checkpoint.needed_args(found, planner)
    state = checkpoint.checked_state(found, planner, args)
    metadata = {"planner": planner, "source_sha256": checkpoint.file_hash(found.path)}
    if args is not None:
        metadata["args"] = json.dumps(args, sort_keys=True)
    if half:
        state = {n: v.half() if v.is_floating_point() else v for n, v in state.items()}
    save_file({name: value.contiguous().clone() for name, value in state.items()}, out, metadata)
    return inspect_checkpoint(str(out))
