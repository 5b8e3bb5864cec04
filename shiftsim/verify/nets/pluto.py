"""PLUTO with deterministic weights against the official code (planner-pluto.md §10)."""

import dataclasses
from pathlib import Path

import numpy as np

from shiftsim.planners.learned.features import SAMPLES
from shiftsim.planners.learned.plan_states import STEP
from shiftsim.planners.learned.pluto.brake import brake, must_brake
from shiftsim.planners.learned.pluto.planner import MAX_AGENTS, RADIUS
from shiftsim.planners.proposals.tracker import STEPS
from shiftsim.verify.array_file import ArrayFile
from shiftsim.verify.nets.common import ERRORS, FILE_COLUMNS, STATE, Scenes, verify_state_dict
from shiftsim.verify.nets.pluto_loops import verify_loop
from shiftsim.verify.nets.pluto_network import NAME, verify_forward
from shiftsim.verify.report import Report
from shiftsim.world import state


def verify_pluto(folder: Path, report: Report, scenes: Scenes) -> None:
    """Compare every file of the folder.

    Args:
        folder: With `state_dict.json` and npz files.
        report: Filled with the comparisons.
        scenes: The scenes that closed loops were recorded on.
    """
    for path in sorted(folder.iterdir()):
        try:
            if path.name == "state_dict.json":
                _verify_manifest(path, report)
            elif path.name.startswith("forward_") and path.suffix == ".npz":
                verify_forward(ArrayFile(path, report))
            elif path.name.startswith("closed_loop_") and path.suffix == ".npz":
                verify_loop(path, report, scenes)
            elif path.name == "emergency_brake.npz":
                _verify_brake(ArrayFile(path, report))
            else:
                report.skip(f"{NAME}: file {path.name}")
        except ERRORS as error:  # the official code got through, so this is a difference
            report.fail(NAME, path.name, f"cannot be compared: {type(error).__name__} {error}")


def _verify_manifest(path: Path, report: Report) -> None:
    from shiftsim.planners.learned.pluto import network as pluto

    network = pluto.build_network()
    trained = sum(value.numel() for value in network.parameters())
    everything = sum(value.numel() for value in network.state_dict().values())
    heads = {
        name: {"C": len(head.gain), **{k: list(v) for k, v in dataclasses.asdict(head).items()}}
        for name, head in pluto.DRIVE_HEADS.items()
    }
    builder = {
        "radius": RADIUS,
        "history_horizon": (SAMPLES - 1) * STEP,
        "future_horizon": STEPS * STEP,
        "sample_interval": STEP,
        "max_agents": MAX_AGENTS,
        "build_reference_line": True,
    }
    verify_state_dict(
        path,
        report,
        NAME,
        {
            "checkpoint": lambda given: {**given, "prefix": pluto.PREFIXES[0]},
            "hyper_parameters": lambda given: pluto.RELEASED,
            "feature_builder": lambda given: builder,
            "total_elements": lambda given: everything,
            "trainable_parameters": lambda given: trained,
            "drive_overrides": lambda given: {
                "meaning": given["meaning"],
                "heads": heads,
                "scale": pluto.DRIVE_SCALES,
            },
        },
    )


def _verify_brake(file: ArrayFile) -> None:
    """Unit cases of the emergency brake."""
    ego, poses = file.take("ego", -1, state.NUM_STATE), file.take("candidate", -1, 81, 3)
    times, speeds = file.take("fault_time", len(ego)), file.take("speed", len(ego))
    braked, given = file["braked"], file.take("states", len(ego), 81, state.NUM_STATE)
    file.columns("columns", FILE_COLUMNS)
    for case in range(len(ego)):
        speed = float(np.hypot(ego[case, state.VX], ego[case, state.VY]))
        file.compare("speed", case, speed, speeds[case])
        must = must_brake(speed, float(times[case]))
        file.compare("braked", case, must, bool(braked[case]))
        ours = np.full((81, state.NUM_STATE), np.nan)
        if must:
            ours = brake(poses[case], ego[case], float(times[case]), state.PACIFICA)
        file.compare("states", case, ours, given[case], STATE)
    file.finish()
