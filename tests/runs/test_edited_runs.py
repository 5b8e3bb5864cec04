"""Runs of edited scenarios: what they are, what identifies them, what is told of them."""

import json

import pytest
from commands import call

import shiftsim
from shiftsim.benchmarks import published
from shiftsim.data.nuplan.filter import read_yaml
from shiftsim.edits.interplan.codes import import_names
from shiftsim.errors import ConfigError
from shiftsim.report.dataset import benchmark_comparison, own_statistics
from shiftsim.report.groups import read_groups
from shiftsim.runs.edited import EditedStore, edits_text, make_edits
from shiftsim.runs.scenarios import open_run_store

pytestmark = pytest.mark.thorough

EDITS = """
[[edit]]
name = "parked"
type = "nudge"
types = ["free"]
spawn = [{at = {ahead_m = 40, left_m = 1.5}, behavior = "stopped"}]

[[edit]]
name = "walk"
tokens = ["0001"]
walk = [{from = {ahead_m = 30, left_m = -4}, to = {ahead_m = 30, left_m = 4}, ego_within_m = 29}]
"""


@pytest.fixture(scope="module")
def edits(tmp_path_factory):
    path = tmp_path_factory.mktemp("edits") / "some.toml"
    path.write_text(EDITS)
    return path


@pytest.fixture(scope="module")
def edited(toy, edits, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "edited"
    return shiftsim.run(
        ["constant-velocity", "log-future"],
        store=str(toy),
        edits=str(edits),
        workers=1,
        out=str(out),
    )


def bytes_of(run):
    tables = {name: (run.path / f"{name}.parquet").read_bytes() for name in ("scores", "metrics")}
    rollouts = sorted((run.path / "rollouts").glob("*.parquet"))
    return tables | {path.name: path.read_bytes() for path in rollouts}


def test_a_run_holds_the_edited_scenarios_only(edited):
    tokens = sorted(set(edited.scores["token"].to_pylist()))
    assert tokens == ["0000cafe-parked", "0001cafe-walk", "0002cafe-parked"]
    assert set(edited.scores["scenario_type"].to_pylist()) == {"nudge", "parked"}
    assert edited.manifest["split"] == "toy+some"
    made = edited.manifest["edits"]["made"]
    assert made["0001cafe-walk"]["base"] == "0001cafe"
    assert edited.manifest["determining"]["edits"]


def test_two_workers_give_the_same_bytes(edited, toy, edits, tmp_path):
    again = shiftsim.run(
        ["constant-velocity", "log-future"],
        store=str(toy),
        edits=str(edits),
        workers=2,
        out=str(tmp_path / "two"),
    )
    assert {k: v for k, v in bytes_of(again).items() if k in ("scores", "metrics")} == {
        k: v for k, v in bytes_of(edited).items() if k in ("scores", "metrics")
    }
    for task, place in edited.rollout_places.items():
        assert place is not None
        scenario = open_run_store(edited).read(task.token)
        ours, theirs = (run.rollout(task, scenario) for run in (edited, again))
        assert ours.ego.tobytes() == theirs.ego.tobytes()
        assert ours.tracks.poses.tobytes() == theirs.tracks.poses.tobytes()


def test_another_edit_is_another_run(edited, toy, tmp_path):
    other = tmp_path / "some.toml"
    other.write_text(EDITS.replace("ahead_m = 40", "ahead_m = 41"))
    with pytest.raises(ConfigError, match="holds another run: edits differ"):
        shiftsim.run(
            ["constant-velocity", "log-future"],
            store=str(toy),
            edits=str(other),
            workers=1,
            out=str(edited.path),
            resume=True,
        )


def test_explain_replay_and_pictures_show_the_edit(edited):
    text = edited.explain("0001cafe-walk", planner="log-future")
    assert "edit walk of 0001cafe: walk: start 30 m ahead, 4 m right" in text
    page = str(edited.view("0001cafe-walk"))
    meta = json.loads(page.partition('id="data-meta">')[2].partition("</script>")[0])
    assert meta["edited"] == ["walk.pedestrian0"]
    assert meta["edits"][0].startswith("walk: start")
    assert any("walk.pedestrian0" in item["tracks"] for item in meta["rollouts"])


def test_a_rollout_of_a_walk_is_read_back_as_it_was(edited):
    store = open_run_store(edited)
    (task,) = [t for t in edited.rollout_places if t[0] == "log-future" and "walk" in t.token]
    log = edited.rollout(task, store.read(task.token))
    column = log.tracks.tokens.index("walk.pedestrian0")
    y = log.tracks.poses[:, column, 1]
    assert y[0] == -4.0
    assert y[-1] > -4.0


def test_a_run_is_scored_again_with_its_edits(edited, tmp_path):
    from shiftsim.runs.derive import rescore

    again = rescore(edited, thresholds="deepplan", out=str(tmp_path / "again"), workers=1)
    assert again.manifest["counts"]["ok"] == 6
    assert again.scores["token"].to_pylist() == edited.scores["token"].to_pylist()


def test_a_bundle_holds_the_recorded_scenarios(toy, edits, tmp_path):
    run = shiftsim.run(
        "constant-velocity",
        store=str(toy),
        edits=str(edits),
        limit=1,
        workers=1,
        bundle=True,
        out=str(tmp_path / "bundled"),
    )
    store = open_run_store(run)
    assert store.read("0000cafe-parked").script.base == "0000cafe"


@pytest.mark.parametrize(
    ("edit", "traffic", "reason"),
    [
        ("spawn = [{at = {ahead_m = 40}}]", "nonreactive", "have no recording to be replayed"),
        ('density = {level = "low"}', "nonreactive", "have no recording"),
        ('slow = [{factor = 0.5, kinds = ["vehicle"]}]', "reactive", "drive by themselves"),
    ],
)
def test_traffic_that_cannot_drive_an_edit_is_refused(toy, tmp_path, edit, traffic, reason):
    path = tmp_path / "e.toml"
    path.write_text(f'[[edit]]\nname = "mine"\n{edit}\n')
    with pytest.raises(ConfigError, match=f"edit 'mine'.*{reason}"):
        shiftsim.run("constant-velocity", store=str(toy), edits=str(path), traffic=traffic)


def test_an_edit_that_cannot_be_applied_fails_its_task_alone(toy, tmp_path):
    path = tmp_path / "e.toml"
    path.write_text('[[edit]]\nname = "mine"\nremove = [{tokens = ["nobody"]}]\n')
    run = shiftsim.run(
        "constant-velocity", store=str(toy), edits=str(path), workers=1, out=str(tmp_path / "r")
    )
    assert run.manifest["counts"]["failed"] == 4
    errors = set(run.tasks["error"].to_pylist())
    assert "edit 'mine' of scenario '0000cafe': there is no track 'nobody'" in errors


def test_an_edit_for_no_scenario_is_refused(toy, tmp_path):
    path = tmp_path / "e.toml"
    path.write_text('[[edit]]\nname = "mine"\ntypes = ["nothing"]\nremove = [{}]\n')
    with pytest.raises(ConfigError, match="are for no scenario of the 4 chosen"):
        shiftsim.run("constant-velocity", store=str(toy), edits=str(path))


def test_edits_of_a_manifest_are_the_same_edits(edits):
    import tomllib

    made = make_edits(tomllib.loads(EDITS), "some")
    again = make_edits(json.loads(json.dumps(made.to_dict())), "other")
    assert again.digest == made.digest
    assert make_edits(tomllib.loads(edits_text(made.to_dict())), "text").digest == made.digest


def test_the_commands_check_and_show_edits(toy, edits, tmp_path):
    done = call(tmp_path, "edits", "check", str(edits), "--store", str(toy))
    assert done.returncode == 0
    assert "3 edited scenarios, 0 refused" in done.stdout
    bad = tmp_path / "bad.toml"
    bad.write_text('[[edit]]\nname = "mine"\nremove = [{tokens = ["nobody"]}]\n')
    done = call(tmp_path, "edits", "check", str(bad), "--store", str(toy))
    assert done.returncode == 1
    assert "refused: edit 'mine' of scenario '0003cafe': there is no track 'nobody'" in done.stdout
    assert "\n0 edited scenarios, " in done.stdout
    done = call(tmp_path, "edits", "show", str(edits), "0001", "--store", str(toy), "-o", "a.png")
    assert done.returncode == 0
    assert (tmp_path / "a.png").stat().st_size > 5000


NAMES = "scenario_tokens:\n  - b000000000000000-dlgloa\n  - a000000000000000-s0\n"
MODIFICATIONS = """
modification_details_dictionary:
  a000000000000000:
    goal: {left: "1.0, 2.0", right: null, straight: null}
    special_scenario:
      '0': {type: jaywalking_pedestrian, pedestrian: [[0.0, 1.0, 2.0, 3.0, null]]}
      '1': {type: avoid_crashed_cars}
"""


def test_interplans_files_are_imported(tmp_path):
    (tmp_path / "names.yaml").write_text(NAMES)
    (tmp_path / "mods.yaml").write_text(MODIFICATIONS)
    done = call(tmp_path, "edits", "import", "names.yaml", "mods.yaml", "-o", "out.toml")
    assert done.returncode == 0, done.stderr
    table = import_names(*(read_yaml(tmp_path / name) for name in ("names.yaml", "mods.yaml")))
    first, second = make_edits(table, "x").edits
    assert (first.name, first.tokens, first.window_s) == ("s0", ("a000000000000000",), 30.0)
    assert list(first.details["special_scenario"]) == ["0"]
    assert second.agents == "assertive"
    text = (tmp_path / "out.toml").read_text()
    assert "pedestrian = [[0.0, 1.0, 2.0, 3.0, 0]]" in text


def test_an_edited_store_reads_what_it_lists(toy, edits):
    store = shiftsim.open_store(toy)
    found = EditedStore(store, make_edits({"edit": [{"name": "e", "remove": {}}]}, "x"))
    assert len(found.tokens) == len(store.tokens)
    assert "0000cafe-e" in found
    assert "0000cafe" not in found
    assert found.read("0000cafe-e").tracks.num_tracks == 0


def test_statistics_and_the_comparison_of_benchmarks_are_of_the_edited_scenarios(edited):
    groups = read_groups([edited])
    found = own_statistics(groups)
    [(label, stats)] = found.items()
    assert set(stats.rows) == {"0000cafe-parked", "0001cafe-walk", "0002cafe-parked"}
    assert stats.types["0000cafe-parked"] == "nudge"
    assert stats.rows["0001cafe-walk"].pedestrians == 1
    table = benchmark_comparison(published(), found, {label})
    assert table.header[-1] == f"{label} (own, edited)"
    last = {row[0]: row[-1] for row in table.rows}
    assert (last["semantic shift"], last["scenario count"]) == ("scenario", "3")


def test_check_names_edits_that_nobody_can_avoid(toy, tmp_path):
    path = tmp_path / "close.toml"
    path.write_text(
        '[[edit]]\nname = "close"\ntokens = ["0000"]\n'
        'spawn = [{at = {ahead_m = 8.5}, behavior = "stopped"}]\n'
    )
    assert call(tmp_path, "edits", "check", path, "--store", toy).returncode == 0
    done = call(tmp_path, "edits", "check", path, "--store", toy, "--avoidable")
    assert done.returncode == 1
    assert "'0000cafe-close': neither braking at 4 m/s^2 nor PDM-Closed" in done.stdout
