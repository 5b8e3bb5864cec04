"""Scores and choices of one recorded step of PDM-Closed, and which differences are exempt.

Exempt are sub-scores that hang on the bearing of an object exactly ahead or behind (it is an
arccos of a number that may round beyond 1), and choices between equal scores. Each is named.
"""

from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.planners.pdm_forecast import Occupants
from shiftsim.planners.pdm_parameters import DEFAULT, DT
from shiftsim.planners.pdm_scorer import TTC_STEPS, normalise, weigh
from shiftsim.planners.pdm_step import Step
from shiftsim.state import HEADING, VX, VY, X, Y
from shiftsim.verify.report import Report

SCORE_TOLERANCE = 1e-9
PROGRESS_TOLERANCE = 1e-6  # m, of the raw progress
TIE = 1e-9  # scores nearer than this are a tie
UNSTABLE_BEARING = 1e-7  # rad from dead ahead or dead behind


@dataclass(frozen=True, slots=True)
class Recorded:
    """Scores of a recorded step; arrays (P,) as in `pdm_scorer.Scores`."""

    total: FloatArray
    no_collision: FloatArray
    drivable: FloatArray
    direction: FloatArray
    progress: FloatArray
    ttc: FloatArray
    comfort: FloatArray
    raw_progress: FloatArray
    collision_index: FloatArray
    ttc_index: FloatArray


def compare_scores(
    report: Report,
    where: str,
    ego: FloatArray,
    step: Step,
    occupants: Occupants,
    theirs: Recorded,
    choice: tuple[int, bool],
) -> bool:
    """Compare sub-scores, scores, choice and brake decision of one step.

    Args:
        report: Receives the comparisons.
        where: Which step.
        ego: (11,) ego state.
        step: Ours.
        occupants: What it was planned from.
        theirs: The recorded scores.
        choice: Number of the recorded best proposal, and whether the emergency brake came instead.

    Returns:
        Whether both chose the same plan, so that plans can be compared.
    """
    ours = step.scores
    collision = _exempt(report, where, step, occupants, theirs, "collision")
    ttc = _exempt(report, where, step, occupants, theirs, "ttc")
    no_collision = np.where(collision, theirs.no_collision, ours.no_collision)
    collision_index = np.where(collision, theirs.collision_index, ours.collision_index)
    ttc_score = np.where(ttc, theirs.ttc, ours.ttc)
    ttc_index = np.where(ttc, theirs.ttc_index, ours.ttc_index)
    factor = no_collision * ours.drivable * ours.direction
    progress = normalise(ours.raw_progress, factor)
    total = factor * weigh(progress, ttc_score, ours.comfort, DEFAULT)
    for name, mine, given, atol in (
        ("no collision", no_collision, theirs.no_collision, 0.0),
        ("collision index", collision_index, theirs.collision_index, 0.0),
        ("drivable area", ours.drivable, theirs.drivable, 0.0),
        ("driving direction", ours.direction, theirs.direction, 0.0),
        ("ttc", ttc_score, theirs.ttc, 0.0),
        ("ttc index", ttc_index, theirs.ttc_index, 0.0),
        ("comfort", ours.comfort, theirs.comfort, 0.0),
        ("raw progress", ours.raw_progress, theirs.raw_progress, PROGRESS_TOLERANCE),
        ("progress", progress, theirs.progress, SCORE_TOLERANCE),
        ("score", total, theirs.total, SCORE_TOLERANCE),
    ):
        report.compare(f"PDM {name}", where, mine, given, atol=atol)
    best = int(np.argmax(total))
    gap = abs(theirs.total[best] - theirs.total[choice[0]])
    if best != choice[0] and gap <= TIE and total.max() - theirs.total[choice[0]] <= TIE:
        report.note(f"PDM choice at {where}: {best} or {choice[0]}, a tie of {gap:.1e}")
        return False
    report.compare("PDM choice", where, best, choice[0])
    is_slow = np.hypot(ego[VX], ego[VY]) <= DEFAULT.brake_speed
    braked = bool(is_slow and DT * collision_index[best] <= DEFAULT.brake_time)
    report.compare("PDM brake", where, braked, choice[1])
    return (step.best, step.braked) == choice


def _exempt(
    report: Report,
    where: str,
    step: Step,
    occupants: Occupants,
    theirs: Recorded,
    kind: str,
) -> np.ndarray:
    """(P,) proposals whose sub-score differs because of an unstable bearing; each is noted."""
    ours = step.scores
    pairs = {
        "collision": (ours.no_collision, theirs.no_collision),
        "ttc": (ours.ttc, theirs.ttc),
    }
    indices = {
        "collision": (ours.collision_index, theirs.collision_index),
        "ttc": (ours.ttc_index, theirs.ttc_index),
    }
    ahead = TTC_STEPS if kind == "ttc" else (0,)
    out = np.zeros(len(ours.total), np.bool_)
    for row in range(len(out)):
        score, index = [pair[row] for pair in pairs[kind]], [pair[row] for pair in indices[kind]]
        first = min(index)
        if (score[0] == score[1] and index[0] == index[1]) or not np.isfinite(first):
            continue
        bearing = _least_bearing(step.driven[row, int(first)], occupants, int(first), ahead)
        if bearing < UNSTABLE_BEARING:
            out[row] = True
            which = f"PDM {kind} at {where}, proposal {row}"
            report.note(f"{which}: an object at a bearing of {bearing:.0e} rad")
    return out


def _least_bearing(
    state: FloatArray, occupants: Occupants, step: int, ahead: tuple[int, ...]
) -> float:
    """Smallest angle between the ego's axis and an object, ahead or behind [rad]."""
    centers = np.concatenate([occupants.centers[(step + later) // 2] for later in ahead])
    if not len(centers):
        return np.inf
    dx, dy = centers[:, 0] - state[X], centers[:, 1] - state[Y]
    cos, sin = np.cos(state[HEADING]), np.sin(state[HEADING])
    return float(np.arctan2(np.abs(cos * dy - sin * dx), np.abs(cos * dx + sin * dy)).min())
