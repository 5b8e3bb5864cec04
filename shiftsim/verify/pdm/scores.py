"""Scores and choices of one recorded step of PDM-Closed, and which differences are exempt.

Exempt are sub-scores that hang on the bearing of an object exactly ahead or behind (it is an
arccos of a number that may round beyond 1, and the object is overlooked), as far as overlooking
such objects explains them, and choices between equal scores. Each is named.
"""

from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.planners.pdm.forecast import Forecast
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.pdm.scorer import TTC_STEPS, Place, normalise, weigh
from shiftsim.planners.pdm.scorer import score as rate
from shiftsim.planners.pdm.step import Step
from shiftsim.planners.proposals.contacts import Others, ego_box, touches_boxes
from shiftsim.planners.proposals.tracker import DT
from shiftsim.verify.report import Report
from shiftsim.world.state import HEADING, PACIFICA, VX, VY, X, Y, center_poses

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
    seen: tuple[Forecast, Place],
    theirs: Recorded,
    choice: tuple[int, bool],
) -> bool:
    """Compare sub-scores, scores, choice and brake decision of one step.

    Args:
        report: Receives the comparisons.
        where: Which step.
        ego: (11,) ego state.
        step: Ours.
        seen: What it was planned from.
        theirs: The recorded scores.
        choice: Number of the recorded best proposal, and whether the emergency brake came instead.

    Returns:
        Whether both chose the same plan, so that plans can be compared.
    """
    ours = step.scores
    collision = _exempt(report, where, step, seen, theirs, "collision")
    ttc = _exempt(report, where, step, seen, theirs, "ttc")
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
    seen: tuple[Forecast, Place],
    theirs: Recorded,
    kind: str,
) -> np.ndarray:
    """(P,) proposals whose sub-score differs because of an unstable bearing; each is noted."""
    ours, (forecast, place) = step.scores, seen
    if kind == "ttc":
        score, index = (ours.ttc, theirs.ttc), (ours.ttc_index, theirs.ttc_index)
    else:
        score = ours.no_collision, theirs.no_collision
        index = ours.collision_index, theirs.collision_index
    out = np.zeros(len(ours.total), np.bool_)
    for row in np.flatnonzero((score[0] != score[1]) | (index[0] != index[1])).tolist():
        states, others = step.driven.states, forecast.others
        first = _unstable(states[row], others, TTC_STEPS if kind == "ttc" else (0,))
        if not first:
            continue
        ignored = others.ignored.copy()
        ignored[list(first)] = True
        blind = others._replace(ignored=ignored)
        rest = rate(states, place, blind, ego_box(PACIFICA), DEFAULT)
        without = (rest.ttc_index if kind == "ttc" else rest.collision_index)[row]
        is_hit = np.isfinite(index[1][row])
        if index[1][row] in {without, *first.values()} and is_hit == (score[1][row] < 1.0):
            out[row] = True
            report.note(f"PDM {kind} at {where}, proposal {row}: an object exactly ahead or behind")
    return out


def _unstable(driven: FloatArray, others: Others, ahead: tuple[int, ...]) -> dict[int, float]:
    """Boxes exactly ahead or behind when the ego, or its projection, first touches them.

    Returns:
        Time index of the touch by box.
    """
    touched = others.ignored.copy()
    size = np.array([PACIFICA.length, PACIFICA.width])
    corners = boxes_to_corners(center_poses(driven[:, :3]), size)
    out: dict[int, float] = {}
    for index, row in enumerate(driven):
        cos, sin = np.cos(row[HEADING]), np.sin(row[HEADING])
        travel = DT * np.hypot(row[VX], row[VY]) * np.array([cos, sin])
        for later in ahead:
            forecast = (index + later) // 2
            box = corners[index] + later * travel
            for hit in np.flatnonzero(touches_boxes(box, others.boxes[forecast]) & ~touched):
                touched[hit] = True
                dx, dy = others.centers[forecast, hit] - row[[X, Y]]
                turn = np.arctan2(abs(cos * dy - sin * dx), abs(cos * dx + sin * dy))
                if turn < UNSTABLE_BEARING:
                    out[int(hit)] = float(index)
    return out
