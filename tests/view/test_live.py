"""The page of a run under way: what it counts, and whom it answers."""

import http.client
import json

import numpy as np
import pytest
from stores import write_toy_store

from shiftsim.cli import main
from shiftsim.data.store.reading import open_store
from shiftsim.report.statistics import bootstrap_interval
from shiftsim.runs.config import make_config
from shiftsim.runs.execute import Progress, execute
from shiftsim.runs.prepare import prepare
from shiftsim.runs.rollouts import Task
from shiftsim.runs.tables import FAILED, OK, TaskResult
from shiftsim.view.live import LiveRun, LiveServer


def ended(number, score, recording="r0", **more):
    """One finished rollout."""
    scores = {"cls": score, "traffic": "nonreactive", "log_name": recording}
    return TaskResult(Task("idm", "none", 0, f"t{number}"), OK, scores=scores, **more)


def run_of(*results, total=10):
    run = LiveRun("runs/x", total, ["idm"], read=None)
    run.add(Progress(len(results), total, 0, news=results))
    return run


@pytest.fixture
def server():
    with LiveServer(run_of(ended(0, 0.5))) as running:
        yield running


def ask(server, path, method="GET", **headers):
    """Status and body of a request with the token, unless the headers say otherwise."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
    connection.request(method, path, headers={"X-Shiftsim-Token": server.token, **headers})
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def test_the_interval_is_that_of_a_report_within_the_scale():
    scores = [("b", 1.0), ("b", 1.0), ("a", 0.2), ("c", 1.0), ("c", 1.0), ("c", 0.9)]
    run = run_of(*[ended(i, score, name) for i, (name, score) in enumerate(scores)])

    (group,) = run.values()["groups"]

    values = np.array([20.0, 100.0, 100.0, 100.0, 100.0, 90.0])  # recordings in order
    found = bootstrap_interval(values, np.array([0, 1, 1, 2, 2, 2]), draws=1000)
    assert group["done"] == 6
    assert group["mean"] == pytest.approx(values.mean())
    assert group["interval"] == pytest.approx([found.low, found.high])
    assert found.high <= 100.0
    assert group["mean"] - found.low > 2.0 * (found.high - group["mean"])  # as it is skewed


def test_one_recording_says_nothing_of_the_spread():
    run = run_of(ended(0, 0.5), ended(1, 0.7))
    assert run.values()["groups"][0]["interval"] == []

    run.add(Progress(3, 10, 0, news=[ended(2, 0.9, "r1")]))

    assert len(run.values()["groups"][0]["interval"]) == 2


def test_planners_come_as_they_were_named_and_noise_from_none_to_high():
    run = LiveRun("runs/x", 6, ["simple", "idm"], read=None)
    names = ["ou-high", "mine:Noise", "ou-low", "none"]
    tasks = [Task(planner, noise, 0, "t") for planner in ("idm", "simple") for noise in names]
    scores = {"cls": 0.5, "traffic": "nonreactive", "log_name": "r0"}
    news = [TaskResult(task, OK, scores=scores) for task in tasks]
    run.add(Progress(len(news), 10, 0, news=news))

    found = [(group["planner"], group["noise"]) for group in run.values()["groups"]]

    order = ["none", "ou-low", "ou-high", "mine:Noise"]
    assert found == [(planner, noise) for planner in ("simple", "idm") for noise in order]


def test_the_worst_are_kept_in_order_with_the_reason():
    violated = {"metric": "drivable_area_compliance", "score": 0.0, "first_violation_s": 4.25}
    late = {"metric": "no_ego_at_fault_collisions", "score": 0.0, "first_violation_s": 9.0}
    comfort = {"metric": "ego_is_comfortable", "score": 0.0, "first_violation_s": 1.0}
    bad = ended(99, 0.0, metrics=[late, comfort, violated])
    better = ended(99, 0.01)  # of the same scenario
    run = run_of(better, *[ended(i, i / 40) for i in range(1, 41)], bad, better)

    worst = run.values()["worst"]

    assert [row["token"] for row in worst] == ["t99", *[f"t{i}" for i in range(1, 20)]]
    assert worst[0]["why"] == "drivable area 4.2 s, at-fault collision 9.0 s"
    assert worst[0]["at"] == 4.25
    assert worst[0]["replay"] is None  # no rollout is stored


def test_failures_are_counted_and_named():
    lost = TaskResult(Task("idm", "none", 0, "t1"), FAILED, error="no plan", hint="return one")
    values = run_of(ended(0, 0.5), lost).values()
    assert values["num_failures"] == values["groups"][0]["failed"] == 1
    assert values["failures"][0]["error"] == "no plan"


def test_nothing_is_shown_without_the_token(server):
    for path in ("/", "/api/state", "/replay?id=1"):
        status, body = ask(server, path, **{"X-Shiftsim-Token": "guess"})
        assert (status, "token" in body) == (403, True)


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "127.0.0.1:1", ""])
def test_other_host_names_are_refused(server, host):
    assert ask(server, "/api/state", Host=host)[0] == 403
    assert ask(server, "/api/state", Origin="http://evil.example")[0] == 403


@pytest.mark.parametrize(
    ("method", "status"), [("POST", 404), ("PUT", 501), ("DELETE", 501), ("OPTIONS", 501)]
)
def test_only_get_is_answered(server, method, status):
    assert ask(server, "/api/state", method)[0] == status


def test_the_token_in_an_address_opens_pages_only(server):
    address = f"token={server.token}"
    header = {"X-Shiftsim-Token": ""}
    assert ask(server, f"/?{address}", **header)[0] == 200
    assert ask(server, f"/replay?id=7&{address}", **header)[0] == 404
    assert ask(server, f"/api/state?{address}", **header)[0] == 403


@pytest.mark.parametrize(
    "path", ["/x", "/replay", "/replay?id=7", "/replay?id=-1", "/../manifest.json"]
)
def test_other_pages_are_not_there(server, path):
    assert ask(server, path)[0] == 404


def test_only_this_machine_is_answered(server):
    assert server.server_address[0] == "127.0.0.1"


def test_the_page_hears_of_the_end_and_then_nothing_is_answered(server):
    with LiveServer(run_of(ended(0, 0.5))) as other:
        assert json.loads(ask(other, "/api/state")[1])["state"] == "running"
        other.end_was_shown.wait = lambda seconds: None  # nobody asks again here
    assert other.run.values()["state"] == "finished"
    with pytest.raises(OSError, match=r"refused|reset"):
        ask(other, "/api/state")


def test_an_interrupt_is_told():
    server = LiveServer(run_of())
    with pytest.raises(KeyboardInterrupt), server:
        raise KeyboardInterrupt
    assert server.run.values()["state"] == "interrupted"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_toy_store(tmp_path_factory.mktemp("live") / "toy", count=4)


def config(store, out, **more):
    values = {"planners": ["constant-velocity"], "store": str(store), "workers": 1, "out": str(out)}
    return prepare(make_config(values | more))


def test_a_run_agrees_with_its_table_and_its_replays_open(store, tmp_path):
    live = LiveRun("x", 4, ["constant-velocity"], open_store(store).read)

    finished = execute(config(store, tmp_path / "run"), on_progress=live.add)

    values = live.values()
    assert values["done"] == values["total"] == 4
    scores = np.array(finished.scores["cls"].to_pylist())
    assert values["groups"][0]["mean"] == pytest.approx(100 * scores.mean(), abs=1e-9)
    assert [row["score"] for row in values["worst"]] == sorted(100 * scores[scores < 1.0])
    page = live.replay(values["worst"][0]["replay"])
    assert values["worst"][0]["token"] in page


def test_a_resumed_run_counts_what_had_finished_before(store, tmp_path):
    def stop(progress):
        if progress.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        execute(config(store, tmp_path / "run"), on_progress=stop)
    live = LiveRun("x", 4, ["constant-velocity"], open_store(store).read)

    finished = execute(config(store, tmp_path / "run", resume=True), on_progress=live.add)

    values = live.values()
    assert values["groups"][0]["done"] == 4
    mean = np.mean(finished.scores["cls"].to_pylist())
    assert values["groups"][0]["mean"] == pytest.approx(100 * mean)


def test_the_command_says_where_the_page_is(store, tmp_path, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setenv("DISPLAY", ":0")
    words = ["run", "-p", "constant-velocity", "--store", str(store), "--workers", "1"]

    with pytest.raises(SystemExit) as left:
        main([*words, "--out", str(tmp_path / "run"), "--live", "--json"])

    printed = capsys.readouterr()
    assert left.value.code in (0, None)
    json.loads(printed.out)
    assert opened == [line for line in printed.err.splitlines() if line.startswith("http")]
    assert opened[0].startswith("http://127.0.0.1:")
