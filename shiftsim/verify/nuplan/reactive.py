"""Reactive runs of the nuplan folder: agents driven against the recorded ego of each run.

The ego states are those of `ego.parquet`, so that what is compared is the traffic alone. Every
column of the reactive rows of `objects.parquet` is compared; heights, which shiftsim does not keep,
with the replayed rows of the same table.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import ShiftsimError
from shiftsim.sim.traffic.idm.agents import order_observed
from shiftsim.sim.traffic.idm.model import IdmTraffic
from shiftsim.verify.nuplan.simulation import STATE_COLUMNS
from shiftsim.verify.report import Report
from shiftsim.verify.tables import Group, read_groups
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LAST_AGENT_KIND, NUM_STATE, AgentKind, Tracks

CHALLENGE = "R"
POSITION, ANGLE, SPEED = 1e-4, 1e-5, 1e-4  # m, rad, m/s; the README allows 1e-3 m
_TOLERANCES = {"x": POSITION, "y": POSITION, "heading": ANGLE, "vx": SPEED, "vy": SPEED}
_KEYS = ("scene", "challenge", "planner")
_NO_VELOCITY = 0.0  # what the official table shows for static objects


@dataclass(frozen=True, slots=True)
class Observed:
    """Rows of one run in nuPlan's order of observation. R rows.

    Attributes:
        iteration: (R,) iterations.
        track: (R,) tracks.
        tracks: Tracks over the iterations.
    """

    iteration: IntArray
    track: IntArray
    tracks: Tracks

    def column(self, name: str) -> np.ndarray:
        """One column of `objects.parquet`."""
        tracks, index = self.tracks, (self.iteration, self.track)
        columns: dict[str, Callable[[], np.ndarray]] = {
            "iteration": lambda: self.iteration,
            "track_token": lambda: np.array([tracks.tokens[i] for i in self.track], object),
            "type": lambda: np.array([AgentKind(k).name for k in tracks.kinds[self.track]], object),
            "x": lambda: tracks.poses[index][:, 0],
            "y": lambda: tracks.poses[index][:, 1],
            "heading": lambda: tracks.poses[index][:, 2],
            "length": lambda: tracks.sizes[index][:, 0],
            "width": lambda: tracks.sizes[index][:, 1],
            "vx": lambda: self._velocity()[:, 0],
            "vy": lambda: self._velocity()[:, 1],
        }
        return columns[name]()

    def _velocity(self) -> FloatArray:
        velocity = self.tracks.velocities[self.iteration, self.track]
        static = self.tracks.kinds[self.track] > LAST_AGENT_KIND
        return np.where(static[:, None], _NO_VELOCITY, velocity)


_COLUMNS = ("iteration", "track_token", "type", *_TOLERANCES, "length", "width")


def verify_nuplan_reactive(
    folder: Path, report: Report, scenes: dict[str, Scenario], *, loops: Path | None = None
) -> None:
    """Compare the objects of every reactive run.

    Args:
        folder: The nuplan folder.
        report: Receives the comparisons.
        scenes: The scenarios by scene name.
        loops: Folder with the tables of other runs in the same scenes, instead of `expected`.
    """
    expected = folder / "expected"
    runs = read_groups((loops or expected) / "ego.parquet")
    objects = read_groups(expected / "objects.parquet")
    if loops is not None:
        logged = {key: rows for key, rows in objects.items() if key[1:] == ("NR", "*")}
        objects = {**logged, **read_groups(loops / "objects.parquet")}
    known = {key for key in runs if key[1] == CHALLENGE}
    for key in sorted({key for key in objects if key[1] == CHALLENGE} - known):
        report.fail("reactive objects", " ".join(key), "ego.parquet has no such run")
    for key in sorted(known):
        try:
            observed = drive(scenes[key[0]], runs[key])
            _compare(observed, objects.get(key), objects.get((key[0], "NR", "*")), key, report)
        except (ShiftsimError, KeyError, ValueError, IndexError) as error:
            report.fail("reactive objects", " ".join(key), f"{type(error).__name__} {error}")


def drive(scenario: Scenario, ego_rows: Group) -> Observed:
    """Run the reactive traffic against recorded ego states (rows of `ego.parquet`)."""
    ego = np.zeros((len(ego_rows["iteration"]), NUM_STATE))
    for column, (index, _) in STATE_COLUMNS.items():
        ego[:, index] = ego_rows[column]
    tracks = scenario.tracks.rows(scenario.iteration_rows[: len(ego)])
    traffic = IdmTraffic()
    traffic.start(scenario, tracks, 0)
    for iteration in range(len(ego) - 1):
        traffic.step(iteration, ego[iteration], tracks, iteration + 1)
    orders = [order_observed(tracks.kinds, row) for row in tracks.valid]
    rows = np.repeat(np.arange(len(ego)), [len(order) for order in orders])
    return Observed(rows, np.concatenate(orders), tracks)


def _compare(
    observed: Observed,
    group: Group | None,
    replayed: Group | None,
    key: tuple[str, ...],
    report: Report,
) -> None:
    where = " ".join(key)
    if group is None:
        report.compare("reactive objects", f"{where}: number", len(observed.track), 0)
        return
    for column in sorted(set(group) - {*_KEYS, *_COLUMNS, "height"}):
        report.skip(f"objects.parquet: column {column!r}")
    for column in _COLUMNS:
        atol = _TOLERANCES.get(column, 0.0)
        report.compare(
            f"reactive {column}", where, observed.column(column), group[column], atol=atol
        )
    heights = _heights(observed, replayed)
    report.compare("reactive height", where, heights, group["height"])


def _heights(observed: Observed, replayed: Group | None) -> FloatArray:
    """Heights of the rows: of vehicles as in the first frame, of others as replayed."""
    if replayed is None:
        return np.full(len(observed.track), np.nan)
    keys = zip(replayed["iteration"].tolist(), replayed["track_token"].tolist(), strict=True)
    height = dict(zip(keys, replayed["height"].tolist(), strict=True))
    kinds, tokens = observed.tracks.kinds, observed.tracks.tokens
    return np.array(
        [
            height.get((0 if kinds[t] == AgentKind.VEHICLE else i, tokens[t]), np.nan)
            for i, t in zip(observed.iteration.tolist(), observed.track.tolist(), strict=True)
        ]
    )
