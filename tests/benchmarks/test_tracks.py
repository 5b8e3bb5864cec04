"""The tracks, lists and published figures that come with the package."""

import csv
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from shiftsim import benchmarks
from shiftsim.benchmarks import TRACKS, known_sets, load_track, published
from shiftsim.benchmarks.bench import open_runs, plan_bench, run_bench
from shiftsim.benchmarks.inventory import coverage
from shiftsim.edits.sampling import GRADES, KINDS
from shiftsim.errors import ConfigError
from shiftsim.metrics import PROFILES
from shiftsim.report.groups import token_digest
from shiftsim.sim.noise import NOISE_NAMES, SIGMA_BY_LEVEL
from shiftsim.sim.perception import parse_drift
from shiftsim.sim.traffic import traffic_name


@pytest.mark.parametrize("name", TRACKS)
def test_a_track_names_only_what_exists(name):
    track = load_track(name)
    assert [parse_drift(noise).name for noise in track.noise] == list(track.noise)
    assert [traffic_name(mode) for mode in track.traffic] == list(track.traffic)
    assert {track.own_thresholds, *(one.thresholds for one in [track.reference] if one)} <= set(
        PROFILES
    )
    assert set(track.drawn.kinds if track.drawn else ()) <= set(KINDS)


def test_state_drift_is_the_papers_seven_settings_and_three_seeds():
    track = load_track("state-drift")
    assert track.noise == NOISE_NAMES
    assert track.seeds == (0, 1, 2)
    assert track.rollouts_per_scenario == 2 * (1 + 6 * 3)
    assert load_track("semantic-shift").rollouts_per_scenario == 2


def test_sensor_drift_has_seeds_for_all_but_latency():
    track = load_track("sensor-drift")
    assert track.rollouts_per_scenario == 2 * (1 + 12 * 3 + 4)


def test_the_track_of_edits_draws_as_many_of_every_kind_and_difficulty():
    track = load_track("edits")
    assert track.reference is None
    assert set(track.drawn.kinds) == set(KINDS)
    assert track.drawn.count % len(GRADES) == 0


def test_the_levels_of_the_track_are_those_of_the_noise():
    table = tomllib.loads(Path(benchmarks.__file__).with_name("state_drift.toml").read_text())
    levels = table["levels"]
    found = {
        name: (level["accel_mps2"], level["steering_rate_radps"]) for name, level in levels.items()
    }
    assert found == SIGMA_BY_LEVEL


def test_an_unknown_track_is_refused():
    with pytest.raises(ConfigError, match="track 'drift' unknown"):
        load_track("drift")


def test_val14_is_known_by_count_and_hash_alone():
    val14 = load_track("semantic-shift").reference
    assert (val14.name, val14.count, val14.tokens) == ("val14", 1118, ())
    assert val14.sha256.startswith("e898725176ccc451a6e19cf045366f44")


def test_lists_agree_with_their_hash_and_count():
    listed = [one for one in known_sets() if one.tokens]
    assert [one.name for one in listed] == ["demo-mini", "demo"]
    for one in listed:
        assert len(set(one.tokens)) == one.count
        assert token_digest(one.tokens) == one.sha256
    assert set(listed[0].tokens) < set(listed[1].tokens)


def test_the_paper_has_as_many_scenarios_per_site_everywhere():
    paper = published()
    assert paper.scenarios.keys() == paper.cities.keys()
    assert sum(paper.scenarios.values()) == int(paper.comparison["scenario count"][-1]) == 1182


@pytest.mark.golden
def test_published_scores_are_those_of_the_paper(shared):
    paper = published()
    with (shared / "reference/paper/semantic_shift.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(map(len, paper.semantic_shift.values())) == len(rows) == 12
    for row in rows:
        found = dict(
            zip(
                paper.columns,
                paper.semantic_shift[row.pop("traffic")][row.pop("planner")],
                strict=True,
            )
        )
        assert found == {name: float(value) for name, value in row.items()}


@pytest.mark.golden
def test_published_robustness_is_that_of_the_paper(shared):
    paper = published()
    with (shared / "reference/paper/noise_robustness.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 5 * 2 * 7
    for row in rows:
        cells = paper.robustness[row["traffic"]][row["set"]][row["planner"]]
        name = f"{row['noise']}-{row['level']}".rstrip("-")
        expected = tuple(float(row[key]) for key in ("mean", "std") if row[key])
        assert tuple(cells[paper.noises.index(name)]) == expected


def test_cities_are_recognised_by_name_and_abbreviation():
    paper = published()
    names = ("san francisco", "SFO", "München", "Muenchen", "Stuttgart", "avenue")
    assert [paper.abbreviation(name) for name in names] == ["SFO", "SFO", "MUC", "MUC", "STR", ""]


@pytest.mark.thorough
def test_the_finding_is_driven_at_home_and_in_foreign_towns(tmp_path, monkeypatch):
    monkeypatch.setenv("SHIFTSIM_DATA", str(tmp_path / "stores"))
    few = tuple(replace(towns, towns=1) for towns in load_track("finding").towns)
    track = replace(load_track("finding"), towns=few)
    settings = {"planners": ["log-future"], "noise": ["none"], "seeds": [0], "workers": 1}
    plan = plan_bench(track, settings | {"limit": 1}, out=str(tmp_path / "out"))
    modes = ("nonreactive", "reactive")
    assert list(plan.runs) == [f"{where}-{mode}" for where in ("home", "foreign") for mode in modes]
    assert [listed.name for listed in plan.own] == ["finding-home", "finding-foreign"]
    done = run_bench(plan)
    assert all(run.is_complete for run in done)
    opened = open_runs([plan.folder])
    [found] = dict.fromkeys(opened.tracks)
    table = coverage(found, opened.groups())
    assert {row[0].split(" ")[0] for row in table.rows} == {"finding-home", "finding-foreign"}
    with pytest.raises(ConfigError, match="towns of its own"):
        plan_bench(track, settings | {"store": "demo"})
