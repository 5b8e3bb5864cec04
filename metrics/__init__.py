"""Closed-loop metrics and the score of one rollout, from its arrays and the map alone.

`compute_metrics` is `evaluate(measure(log, road), thresholds)`: the geometry is measured once, and
any number of threshold profiles can be applied to it.
"""

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any

from shiftsim.errors import ConfigError
from shiftsim.files import load_attribute
from shiftsim.metrics.result import DEEPPLAN as DEEPPLAN
from shiftsim.metrics.result import NUPLAN as NUPLAN
from shiftsim.metrics.result import PROFILES as PROFILES
from shiftsim.metrics.result import Collision as Collision
from shiftsim.metrics.result import MetricRow as MetricRow
from shiftsim.metrics.result import Series as Series
from shiftsim.metrics.result import Statistic as Statistic
from shiftsim.metrics.result import Thresholds as Thresholds
from shiftsim.metrics.result import Violation as Violation
from shiftsim.metrics.result import thresholds_of as thresholds_of
from shiftsim.metrics.score import MULTIPLIERS as MULTIPLIERS
from shiftsim.metrics.score import SHORT_NAMES as SHORT_NAMES
from shiftsim.metrics.score import WEIGHTS as WEIGHTS
from shiftsim.metrics.score import Measurements as Measurements
from shiftsim.metrics.score import MetricResult as MetricResult
from shiftsim.metrics.score import evaluate as evaluate
from shiftsim.metrics.score import measure as measure
from shiftsim.sim.log import SimulationLog
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario

METRIC_VERSION = "1"  # raised with any change of a definition
CustomMetric = Callable[[SimulationLog, VectorMap], float | MetricRow]
NAMED = {"navsim": "shiftsim.metrics.navsim_rollouts:metric_rows"}  # further ones that come with it


def compute_metrics(
    log: SimulationLog,
    road: VectorMap | Scenario,
    *,
    thresholds: str | Thresholds = "nuplan",
    own: Sequence[str | CustomMetric] = (),
) -> MetricResult:
    """Score one rollout as nuPlan does.

    Args:
        log: The rollout.
        road: Map it was driven on, or the scenario with that map.
        thresholds: Profile name, or thresholds of your own.
        own: Metrics of your own, as callables or `module:attribute`, or `navsim`, which needs the
            scenario; they are reported in `extra` and never enter the score.

    Raises:
        DataError: The rollout is too short or not finite.
        MapError: The map is such that nuPlan's own code stops.

    Example:
        ```python
        scenario = shiftsim.open_store("demo")["01f13e"]
        result = shiftsim.score(shiftsim.simulate(scenario, "idm"), scenario.map)
        print(result.score, result.scores)
        ```
    """
    result = evaluate(measure(log, road.map if isinstance(road, Scenario) else road), thresholds)
    return add_metrics(result, log, road, own) if own else result


def load_metric(spec: str | CustomMetric) -> CustomMetric:
    """The callable that `module:attribute` names, or the callable itself; else a ConfigError."""
    if not isinstance(spec, str):
        return spec
    spec = NAMED.get(spec, spec)
    module_name, _, attribute = spec.partition(":")
    hint = "name it as module:attribute, for example my_package.metrics:min_gap"
    if not module_name or not attribute:
        raise ConfigError(f"metric {spec!r} is not of the form module:attribute", hint)
    metric = load_attribute("metric", spec, hint)
    if not callable(metric):
        raise ConfigError(f"metric {spec!r} is not callable but {type(metric).__name__}", hint)
    found: CustomMetric = metric
    return found


def add_metrics(
    result: MetricResult,
    log: SimulationLog,
    road: VectorMap | Scenario,
    metrics: Sequence[str | CustomMetric],
) -> MetricResult:
    """The same result with the rows of custom metrics in `extra`; the score stays as it is.

    Raises ConfigError: a metric cannot be loaded, or two rows have the same name.
    """
    rows = [row for metric in metrics for row in _run(load_metric(metric), log, road)]
    taken = {*result.scores, *SHORT_NAMES}
    for row in rows:
        if row.metric in taken:
            raise ConfigError(f"metric name {row.metric!r} is taken", "rename the custom metric")
        taken.add(row.metric)
    return replace(result, extra=tuple(rows))


def _run(metric: Any, log: SimulationLog, road: VectorMap | Scenario) -> list[MetricRow]:
    name, map = getattr(metric, "__name__", type(metric).__name__), road
    if isinstance(road, Scenario):
        map = road.map
    if getattr(metric, "of_scenario", False):
        if not isinstance(road, Scenario):
            raise ConfigError(f"metric {name!r} needs the scenario", "give it instead of its map")
        found: list[MetricRow] = metric(log, road)
        return found
    value = metric(deepcopy(log), map)  # what it writes there is not in what is stored
    if isinstance(value, MetricRow):
        return [value]
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        what = f"metric {name!r} returned {value!r}"
        raise ConfigError(what, "return a number or a MetricRow") from error
    return [MetricRow(name, None, number, "", None, None)]


if __name__ == "metrics":  # pragma: no cover
    raise ImportError("import it as shiftsim.metrics")
