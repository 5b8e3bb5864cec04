"""What a nuPlan log offers, and one of its scenarios, without a store."""

from collections import Counter
from pathlib import Path
from typing import Any

from shiftsim.data.nuplan.log import open_log
from shiftsim.data.nuplan.scenarios import Mapping, ScenarioEntry, cut_window, offered, read_span
from shiftsim.data.recording import scenario
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario


def list_scenarios(path: Path, **choice: Any) -> list[ScenarioEntry]:
    """As `offered`, of the log in a file."""
    with open_log(path) as log:
        return offered(log, **choice)


def read_scenario(
    path: Path,
    token: str,
    road: VectorMap,
    mapping: Mapping | None = None,
    flaws: Counter[str] | None = None,
) -> Scenario:
    """One scenario of a log, as `cut_window` cuts it out; counts what is tolerated in `flaws`."""
    counts = Counter[str]() if flaws is None else flaws
    with open_log(path) as log:
        window = cut_window(log, token, mapping)
        recording, ego = read_span(log, log.name, window.first_row, window.last_row, counts)
    return scenario(recording, ego, window, road, offset=window.first_row)
