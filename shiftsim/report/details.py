"""Tables beyond the paper's: a ranking, planners compared, scenario types, edits, times."""

from collections.abc import Mapping, Sequence
from itertools import combinations, product

import numpy as np
import pyarrow.compute as pc

from shiftsim.edits.sampling import GRADES, graded
from shiftsim.errors import plural
from shiftsim.kernels import FloatArray
from shiftsim.metrics import MULTIPLIERS, navsim_rollouts, open_loop
from shiftsim.report import statistics
from shiftsim.report.groups import COLUMNS, Group, by_set, distinct_sets, planner_identities
from shiftsim.report.statistics import FEW_CLUSTERS, Comparison, score_interval
from shiftsim.report.tables import Cell, Interval, Number, Record, Row, Table
from shiftsim.report.words import REASONS, UNITS
from shiftsim.sim.perception import drift_order

ALL_KINDS = "all"
_BORNE = 5.0  # points of the score that a planner may lose to what it is said to bear
_SIGNIFICANT = 0.05  # p-value below which a difference is called so


def ranking(groups: Sequence[Group]) -> Table | None:
    """Complete groups by score without noise, beside that under the hardest; None without any."""
    places = list(dict.fromkeys(map(_place, groups)))
    known = [group for group in groups if group.is_complete]
    known.sort(key=lambda group: (places.index(_place(group)), -_score(group)))
    noises = drift_order(group.noise for group in known)
    means = {name: np.mean([*map(_score, _under(known, name))]) for name in noises}
    first, hardest = next(iter(noises), ""), min(noises[1:], key=means.__getitem__, default="")
    heads = ["without noise" if name == "none" else f"under {name}" for name in (first, hardest)]
    noisy = {(*_place(group), group.planner): group for group in _under(known, hardest)}
    records = list[Record]()
    for group in _under(known, first):
        record: Record = {"set": group.data.label, "traffic": group.traffic}
        record |= {"planner": group.planner, heads[0]: group.estimate()}
        record["95 % CI"] = score_interval(group)
        if hardest:
            other = noisy.get((*_place(group), group.planner))
            record[heads[1]] = other.estimate() if other else None
            record["95 % CI with it"] = score_interval(other) if other else None
        records.append(record)
    if not records:
        return None
    largest = max(known, key=lambda group: len(group.data.tokens))
    field = [group for group in known if _place(group) == _place(largest)]
    few = min(group.data.num_recordings for group in known)
    left_out = ", ".join(f"{g.planner} {g.noise} {g.traffic}" for g in groups if g not in known)
    notes = [
        *(data.rules for data in distinct_sets(known)),
        "95 % CI: cluster bootstrap over recordings; it leaves out what the seeds change",
        *([f"few recordings ({few}): intervals are too narrow"] if few < FEW_CLUSTERS else []),
        *([f"not ranked, as scores are missing: {left_out}"] if left_out else []),
    ]
    best = {name: max for name in heads if name in records[0]}
    findings = _findings(_under(field, first), _under(field, hardest), heads)
    findings.append(_zeros(field))
    title = "Ranking: closed-loop score × 100"
    return Table.of("ranking", title, records, 3, notes=notes, best=best, findings=findings)


def _place(group: Group) -> tuple[object, ...]:
    return group.data.key, group.traffic


def _score(group: Group) -> float:
    return 100.0 * float(group.seed_means().mean())


def _under(groups: Sequence[Group], noise: str) -> list[Group]:
    return [group for group in groups if group.noise == noise]


def _findings(clean: Sequence[Group], noisy: Sequence[Group], heads: Sequence[str]) -> list[str]:
    """Who is first, how sure that is, and what the noise changes; the best planners come first."""
    said, before = list[str](), {group.planner: _score(group) for group in clean}
    if clean:
        first, traffic = clean[0], clean[0].run.manifest["determining"]["traffic"]
        interval, second = score_interval(first), clean[1] if len(clean) > 1 else None
        sure = f" (95 % interval {interval.low:.2f} to {interval.high:.2f})" if interval else ""
        scenarios = f"{plural(len(first.data.tokens), 'scenario')} in {traffic} traffic"
        verb = "is first with" if second else "scores"
        lead = f"{first.planner} {verb} {_score(first):.2f}{sure} {heads[0]}, on {scenarios}"
        if second:
            lead += f"; {second.planner} follows, {_score(first) - _score(second):.2f} behind"
        if second and second.seeds == first.seeds:  # these two are the first pair
            alike = [group for group in clean if group.seeds == first.seeds]
            p = statistics.holm([one.p_value for one in _compared(alike)[1]])[0]
            sign = "significant" if p < _SIGNIFICANT else "not significant"
            lead += f", which is {sign} (p = {p:.2g}, Holm)"
        said.append(f"{lead}.")
    if not noisy:
        return [*said, "There are no complete scores under noise."]
    changes = [(_score(g) - before[g.planner], g.planner) for g in noisy if g.planner in before]
    ends = dict.fromkeys((min(changes), max(changes)) if changes else ())
    each = (f"{f'{change:.2f}'.replace('-', '−')} ({name})" for change, name in ends)
    change = f"scores change by {' to '.join(each)}; " if ends else ""
    stays = "stays" if clean and clean[0].planner == noisy[0].planner else "is"
    leads = f"{noisy[0].planner} {stays} first with {_score(noisy[0]):.2f}"
    return [*said, f"{heads[1].capitalize()} {change}{leads}."]


def _zeros(field: Sequence[Group]) -> str:
    """How many rollouts score 0, and because of what."""
    values = np.concatenate([group.values.reshape(-1, len(COLUMNS)) for group in field])
    rollouts = dict(zip(COLUMNS, values.T, strict=True))
    zero = rollouts["cls"] == 0.0
    counts = {REASONS[name]: int(np.sum(zero & (rollouts[name] == 0.0))) for name in MULTIPLIERS}
    causes = sorted(filter(counts.get, counts), key=counts.__getitem__, reverse=True)
    because = ", ".join(f"{name} in {counts[name]}" for name in causes)
    return f"{zero.sum()} of {len(zero)} rollouts score 0{': ' * bool(because)}{because}."


def planner_comparison(groups: Sequence[Group], *, noisy: bool = False) -> Table | None:
    """Every pair of planners on the same scenarios, clean or noisy; None where there is no pair."""
    blocks: dict[tuple[object, ...], list[Group]] = {}  # they differ in nothing but the planner
    for group in (group for group in groups if (group.noise != "none") == noisy):
        without_pair = "" if group.is_complete else group.planner
        key = (group.data.key, group.traffic, group.noise, group.seeds, without_pair)
        blocks.setdefault(key, []).append(group)
    pairs = [block for block in blocks.values() if len(block) > 1]
    alone = [block[0] for block in blocks.values() if len(block) == 1]
    if not pairs:
        return None
    notes = [
        *(data.rules for data in distinct_sets(groups)),
        "95 % CI: cluster bootstrap over recordings; p: the sign of each recording's difference "
        "flipped at random; Holm: corrected for all pairs of the same set, traffic and noise",
    ]
    found = [*map(_compared, pairs)]
    records = [record for each, _ in found for record in each]
    results = [result for _, each in found for result in each]
    few = min(block[0].data.num_recordings for block in pairs)
    if few < FEW_CLUSTERS:
        notes.append(
            f"few recordings ({few}): intervals are too narrow, and no p can be below "
            f"{max(result.smallest_p for result in results):.4f}"
        )
    if alone:
        words = "not compared, as rollouts are missing or no other planner has the same seeds"
        names = (f"{group.planner} {group.noise} {group.traffic}" for group in alone)
        notes.append(f"{words}: {', '.join(names)}")
    title = (
        f"Planners compared scenario by scenario, {'under noise' if noisy else 'clean'}: "
        "difference of closed-loop scores × 100, first minus second"
    )
    name = f"planner-comparison{'-noise' if noisy else ''}"
    drawn = ("difference", statistics.forest(results))
    return Table.of(name, title, records, 5, notes=notes, drawn=drawn)


def _compared(block: Sequence[Group]) -> tuple[list[Record], list[Comparison]]:
    """A record per pair of groups, and what it was made of."""
    clusters = statistics.cluster_codes(block[0].data.recordings)
    pairs = [*combinations(block, 2)]
    scores = ((100.0 * a.scenario_means(), 100.0 * b.scenario_means()) for a, b in pairs)
    results = [statistics.compare(*both, clusters) for both in scores]
    corrected = statistics.holm([result.p_value for result in results])
    records: list[Record] = [
        {
            **{"set": first.data.label, "traffic": first.traffic, "noise": first.noise},
            **{"first": first.planner, "second": second.planner},
            "difference": Number(result.difference),
            "95 % CI": result.interval,
            "better/same/worse": f"{result.wins}/{result.ties}/{result.losses}",
            "p": Number(result.p_value, 4),
            "p (Holm)": Number(p_value, 4),
        }
        for (first, second), result, p_value in zip(pairs, results, corrected, strict=True)
    ]
    return records, results


def scenario_types(groups: Sequence[Group]) -> list[Table]:
    """Clean scores by scenario type, planners side by side; sets of one type are left out."""
    out = []
    for data, mine in by_set(group for group in groups if group.noise == "none"):
        parts = [dict(group.split("scenario_type")) for group in mine]
        rows: list[Row] = [
            (name, Number(len(part.data.tokens), 0), *(each[name].estimate() for each in parts))
            for name, part in parts[0].items()
        ]
        header = ("type", "scenarios", *(f"{g.planner} {g.traffic}" for g in mine))
        title = f"Scores by scenario type: {data.label}, clean, closed-loop score × 100"
        if len(rows) > 1:
            out.append(Table(f"scenario-types_{data.name}", title, header, rows, 1, (data.rules,)))
    return out


def edited_scores(groups: Sequence[Group]) -> list[Table]:
    """Scores of edited scenarios by kind and difficulty, beside the recorded; a table per set."""
    out = []
    for data, mine in by_set(group for group in groups if group.data.edits):
        kinds, difficulties = np.array([graded(name) for name in data.types], str).T
        names = np.unique(kinds).tolist()
        grades = [*GRADES] if any(difficulties) else []
        is_noisy = any(group.noise != "none" for group in mine)
        total = "interPlan score" if data.is_interplan else "all"
        records: list[Record] = []
        for group in mine:
            for name in [*names, ALL_KINDS] if len(names) > 1 else names:
                where = (kinds == name) | (name == ALL_KINDS)
                part = group.only(where)
                record: Record = {"traffic": group.traffic, "planner": group.planner}
                record |= {"noise": group.noise} if is_noisy else {}
                record |= {"kind": name or "unknown", "scenarios": Number(len(part.data.tokens), 0)}
                if not data.is_interplan:
                    record["recorded"] = recorded_score(part, groups)[0]
                record |= {one: part.only(difficulties[where] == one).estimate() for one in grades}
                records.append(record | {total: part.estimate()})
        of_total = "interPlan score: its metrics and weights, mean over the scenarios"
        without = "recorded: the same scenarios without the edit"
        notes = [data.rules, of_total if data.is_interplan else without]
        if grades:
            each = ", ".join(f"{name} {most:g}" for name, most in GRADES.items())
            notes.append(
                f"difficulty: braking that avoids it [m/s²], up to {each}; hard also where only "
                "PDM-Closed avoids it"
            )
        title = f"Edited scenarios: {data.label}, closed-loop score × 100"
        num_labels, name = 3 + is_noisy, f"edits_{data.name}"
        best = dict.fromkeys([*records[0]][num_labels + 1 :], max)
        out.append(Table.of(name, title, records, num_labels, notes=notes, best=best))
    return out


def recorded_score(group: Group, others: Sequence[Group]) -> tuple[Number | None, Interval | None]:
    """Score and interval of the scenarios that a group's were made of, if a group has them."""
    edited = group.run.manifest["edits"]["made"]
    bases = [str(edited[token]["base"]) for token in group.data.tokens]
    for other in others:
        place = {token: i for i, token in enumerate(other.data.tokens)}
        is_alike = not other.data.edits and _driven_as(other) == _driven_as(group)
        if bases and is_alike and set(bases) <= set(place):
            values = 100.0 * other.scenario_means()[[place[token] for token in bases]]
            if np.isfinite(values).all():
                clusters = statistics.cluster_codes(group.data.recordings)
                interval = statistics.bootstrap_interval(values, clusters)
                return Number(float(values.mean())), interval
    return None, None


def _driven_as(group: Group) -> tuple[object, ...]:
    data = group.data
    labels = (group.traffic, group.planner, group.noise, group.seeds)
    return (*labels, data.windows, *data.traits[:3])


def drift_matrix(groups: Sequence[Group]) -> Table | None:
    """Scores by planner, traffic and what drifts, and their changes; None without such runs."""
    drifts = [group for group in groups if _senses(group)]
    modes = list(dict.fromkeys(group.traffic for group in drifts))
    records, findings = list[Record](), list[str]()
    for data, mine in by_set([*_under(groups, "none"), *drifts] if drifts else []):
        for planner in dict.fromkeys(group.planner for group in mine):
            own = [group for group in mine if group.planner == planner]
            by_mode = {mode: {g.noise: g for g in own if g.traffic == mode} for mode in modes}
            for noise in drift_order(noise for found in by_mode.values() for noise in found):
                record: Record = {"set": data.label, "planner": planner, "drift": noise}
                for mode, found in by_mode.items():
                    record[mode] = found[noise].estimate() if noise in found else None
                    record[f"{mode} change"] = _change(found.get("none"), found.get(noise))
                records.append(record)
            findings += [_borne(planner, mode, found) for mode, found in by_mode.items()]
    if not records:
        return None
    words = "planners that are given the recording drive by it, whatever is seen: {}"
    informed = {g.name for g in drifts if planner_identities(g.run)[g.name].get("sees_recording")}
    notes = [data.rules for data in distinct_sets(drifts)]
    borne = (
        f"a latency is borne if it and shorter ones that were run cost at most {_BORNE:g} points"
    )
    notes += [borne] if any(findings) else []
    notes += [words.format(", ".join(sorted(informed)))] if informed else []
    title = "Planner × traffic × drift: closed-loop score × 100"
    return Table.of("drift", title, records, 3, notes=notes, findings=[*filter(None, findings)])


def _senses(group: Group) -> bool:
    """Whether something but the actuation drifts."""
    fields = group.run.manifest["determining"].get("noise", {}).get(group.noise, {})
    return bool({"perception", "localization", "latency"} & {*fields})


def _change(before: Group | None, after: Group | None) -> Number | None:
    if not (before and after) or before is after or not (before.is_complete and after.is_complete):
        return None
    return Number(_score(after) - _score(before))


def _borne(planner: str, mode: str, groups: Mapping[str, Group]) -> str:
    """How late the plans of a planner may be before its score falls; empty where it is unknown."""
    scores = {noise: _score(group) for noise, group in groups.items() if group.is_complete}
    late = [name for name in drift_order(scores) if name[8:].isdecimal()]
    if not scores.get("none", 0.0) > _BORNE or not late:  # there is nothing that could fall
        return ""
    falls = [name for name in late if scores[name] < scores["none"] - _BORNE]
    borne = late[: late.index(falls[0])] if falls else late
    upto = f"a latency of {borne[-1][8:]} ms" if borne else "no latency that was run"
    if not falls:
        return f"{planner} bears {upto} ({mode}), the longest that was run."
    lost = f"loses {scores['none'] - scores[falls[0]]:.1f} points at {falls[0][8:]} ms"
    return f"{planner} bears {upto} ({mode}) and {lost}."


def has_open_loop(group: Group) -> bool:
    """Whether the run was asked for open-loop scores."""
    return bool(group.run.manifest["config"].get("open_loop"))


def open_loop_scores(groups: Sequence[Group]) -> Table | None:
    """Open loop beside closed loop, of the runs that asked for it."""
    asked = [group for group in groups if has_open_loop(group)]
    each = {(group.run.path, group.planner): group for group in reversed(asked)}
    if not each:
        return None
    records = [_open_loop_record(group) for group in reversed(each.values())]
    counts = dict.fromkeys(str(record["plans"]) for record in records if record["plans"])
    notes = (
        "CLS: closed loop under that noise; open loop: nuPlan's score of the plans along the "
        "recording; errors: means over plans and horizons of 3, 5 and 8 s; missed: largest share "
        "of plans that are too far away; where plans were not compared, as the recording ends, "
        "the score is not nuPlan's",
        f"plans compared: {', '.join(counts)}",
    )
    title = "Open loop beside closed loop, scores × 100"
    scores, errors = [*records[0]][4:6], [*records[0]][6:-2]
    best = dict.fromkeys(scores, max) | dict.fromkeys(errors, min)
    return Table.of("open-loop", title, records, 4, notes=notes, best=best)


def open_loop_values(group: Group, metric: str) -> FloatArray:
    """(N,) an open-loop metric's mean over the seeds of every scenario; NaN where there is none."""
    metrics = group.metrics
    mine = metrics.filter(pc.equal(metrics["metric"], metric))
    means = mine.group_by("token").aggregate([("value", "mean")])
    found = {row["token"]: row["value_mean"] for row in means.to_pylist()}
    return np.array([found.get(token) for token in group.data.tokens], np.float64)


def _open_loop_record(group: Group) -> Record:
    metrics, means = group.metrics, _metric_means(group)
    plans = metrics.filter(pc.equal(metrics["metric"], open_loop.COUNT))
    counted, there = (pc.sum(plans[name]).as_py() for name in ("value", "threshold"))

    def mean(name: str, scale: float = 1.0) -> Number | None:
        return None if (value := means.get(name)) is None else Number(scale * value)

    return {
        **{"set": group.data.label, "traffic": group.traffic, "planner": group.planner},
        "noise": group.noise,
        "CLS": group.estimate(),
        "open loop": mean(open_loop.TOTAL, 100.0),
        **{f"{name} {UNITS[unit]}": mean(m) for m, (name, unit, *_) in open_loop.METRICS.items()},
        "missed": mean(open_loop.MISS),
        "rollouts": Number(len(plans), 0),
        "plans": f"{counted:.0f} of {there:.0f}" if counted else None,
    }


def navsim_scores(groups: Sequence[Group]) -> Table | None:
    """NAVSIM's scores of rollouts, in both modes, of the runs that asked for them."""
    asked = [one for one in groups if "navsim" in one.run.manifest["config"].get("metrics", ())]
    records = list[Record]()
    for group, mode in product(asked, navsim_rollouts.MODES):
        labels = {"set": group.data.label, "traffic": group.traffic, "planner": group.planner}
        means = _metric_means(group)
        record: Record = {**labels, "noise": group.noise, "scored": mode, "CLS": group.estimate()}
        for column in navsim_rollouts.COLUMNS:
            value = means.get(navsim_rollouts.metric_name(mode, column))
            scale, digits = (1.0, 0) if column == navsim_rollouts.FRAMES else (100.0, 2)
            record[column] = None if value is None else Number(scale * value, digits)
        records.append(record)
    if not records:
        return None
    notes = (
        "plans: the plan of each half second as a proposal; windows: the 4 s driven from there; "
        "the world is that of the rollout, no human filter acts, and neither is NAVSIM's own score",
        "means over the frames of a rollout, then over rollouts; frames: how many were scored",
    )
    return Table.of("navsim", "PDMS and EPDMS of rollouts, × 100", records, 5, notes=notes)


def _metric_means(group: Group) -> dict[str, float]:
    """Means over the rollouts of a group, by metric; NaN is left out."""
    found = group.metrics.group_by("metric").aggregate([("value", "mean")])
    return dict(zip(found["metric"].to_pylist(), found["value_mean"].to_pylist(), strict=True))


def planning_times(groups: Sequence[Group]) -> Table:
    """How long planners think, and how often the simulator's fallback plan had to do."""
    each = {(group.run.path, group.planner): group for group in groups}
    machines = []
    for group in groups:
        manifest = {"workers": "?", "machine": {}} | group.run.manifest
        processor, cores = (manifest["machine"].get(name, "?") for name in ("processor", "cores"))
        machines.append(f"machine: {processor}, {cores} cores, {manifest['workers']} workers")
    notes = (
        "per step: mean and 95th percentile within a rollout, of both the median over the "
        "rollouts, which compilation at the start of a run does not touch; per rollout: the "
        "median of reading, driving and scoring",
        *dict.fromkeys(machines),
    )
    title = "Planning time, and steps driven on a degraded (fallback) plan"
    records = [*map(_times_record, each.values())]
    best = dict.fromkeys([*records[0]][4:], min)
    return Table.of("planning-time", title, records, 3, notes=notes, best=best)


def _times_record(group: Group) -> Record:
    tasks, scores = group.run.tasks, group.run.scores
    finished = pc.equal(tasks["status"], "ok")
    done = tasks.filter(pc.and_(pc.equal(tasks["planner"], group.name), finished))
    degraded = scores.filter(pc.equal(scores["planner"], group.name))["degraded_steps"].to_numpy()

    def known(name: str) -> FloatArray:
        values = done[name].to_numpy() if name in done.column_names else np.zeros(0)
        return values[np.isfinite(values)]

    def medians(*names: str, digits: int = 2) -> Cell:
        found = [float(np.median(values)) for name in names if len(values := known(name))]
        return Number(sum(found), digits) if found else None

    tail = known("planning_ms_p95")
    return {
        **{"set": group.data.label, "traffic": group.traffic, "planner": group.planner},
        "rollouts": Number(len(done), 0),
        "ms per step": medians("planning_ms_mean"),
        "95 % ms": medians("planning_ms_p95"),
        "worst 95 % ms": Number(float(tail.max())) if len(tail) else None,
        "s per rollout": medians("read_seconds", "simulate_seconds", "metrics_seconds", digits=3),
        "degraded steps": Number(int(degraded.sum()), 0),
        "in rollouts": Number(int(np.sum(degraded > 0)), 0),
    }
