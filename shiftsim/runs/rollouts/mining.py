"""What went wrong in a run, as scenarios that begin shortly before.

Each is an edit of the recorded scenario: until its start the ego has driven what the rollout drove,
among the others of that rollout. From there on any planner can drive.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import ConfigError, one_of
from shiftsim.files import write_text
from shiftsim.kernels import FloatArray
from shiftsim.runs.edited import edits_text, make_edits
from shiftsim.runs.results import Run
from shiftsim.runs.rollouts import Task
from shiftsim.runs.scenarios import open_run_store

KINDS = {  # what can go wrong, and the metric that tells when
    "collision": "no_ego_at_fault_collisions",
    "off-road": "drivable_area_compliance",
    "wrong-way": "driving_direction_compliance",
    "ttc": "time_to_collision_within_bound",
    "speeding": "speed_limit_compliance",
}
AFTER = 5.0  # s of a scenario beyond what went wrong, where nothing else is asked for
_NAME = 40  # letters of planner and noise in a name


def mine(
    run: Run,
    kind: str = "collision",
    *,
    before: float = 3.0,
    window: float | None = None,
    planner: str = "",
    out: str | Path = "mined.toml",
) -> Path:
    """Write edits that begin before what went wrong in the rollouts of a run; the file.

    Args:
        run: A run of recorded scenarios, with rollouts.
        kind: `collision`, `off-road`, `wrong-way`, `ttc` or `speeding`.
        before: How long before the first violation they begin [s].
        window: Duration of the scenarios [s]; 5 s more than `before` if None. Where the recording
            ends sooner, they begin earlier.
        planner: Only its rollouts.
        out: The .toml file.

    Raises:
        ConfigError: Nothing of the kind went wrong, or the run drove edited scenarios.
        DataError: Rollouts were not stored, or the store is another one.
    """
    one_of("kind", kind, KINDS)
    if run.manifest.get("edits"):
        hint = "an edit has no second beginning: run without --edits, and mine that run"
        raise ConfigError(f"run {run.path.name!r} drove edited scenarios", hint)
    window = before + AFTER if window is None else window
    edits, traffic = list[dict[str, Any]](), run.manifest["determining"]["traffic"]
    store = open_run_store(run)
    for row in run.metrics.to_pylist():
        at = row["first_violation_iteration"]
        is_wrong = row["metric"] == KINDS[kind] and at is not None and row["score"] != 1.0
        if not is_wrong or planner not in ("", row["planner"]):
            continue
        task = Task(*(row[name] for name in Task._fields))
        scenario = store.read(task.token)
        left = scenario.num_iterations - 1 - round(10.0 * window)
        start = max(min(at - round(10.0 * before), left), 0)
        ego: FloatArray = run.rollout(task, scenario).ego[: start + 1]
        seconds = float(np.diff(scenario.iteration_times[[start, -1]])[0]) * 1e-6
        label = re.sub(r"\W", "_", f"{task.planner}_{task.noise}", flags=re.ASCII)[:_NAME]
        edit = {
            "name": f"{kind.replace('-', '_')}_{label}_{task.seed}",
            "tokens": [task.token],
            "type": kind,
            "window_s": min(window, round(seconds, 1)),
            "start": {"ego": ego.tolist(), "traffic": traffic},
        }
        edits.append(edit)
    if not edits:
        raise ConfigError(
            f"run {run.path.name!r} has no rollout with {kind!r}",
            hint="look at `shiftsim report RUN`, or choose another kind",
        )
    path = Path(out)
    make_edits({"edit": edits}, path.stem)  # what it says can be read
    write_text(path, edits_text({"format": 1, "edit": edits}))
    return path
