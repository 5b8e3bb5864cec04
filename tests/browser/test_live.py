"""The page of a run under way, in a browser."""

from threading import Event, Thread

import pytest
from contrast import FAINT
from stores import write_toy_store

from shiftsim.data.store.reading import open_store
from shiftsim.runs.config import make_config
from shiftsim.runs.execute import execute
from shiftsim.runs.prepare import prepare
from shiftsim.view.live import LiveRun, LiveServer

SIZES = [(1440, 900), (800, 600), (390, 844)]


class Watched:
    """A run that waits after every rollout until it may go on."""

    def __init__(self, folder):
        store = write_toy_store(folder / "store", count=4)
        values = {"planners": ["constant-velocity", "log-future"], "store": str(store)}
        self.prepared = prepare(make_config({**values, "workers": 1, "out": str(folder / "run")}))
        total = len(self.prepared.tasks)
        self.live = LiveRun(
            "runs/<i>x</i>", total, ["constant-velocity", "log-future"], open_store(store).read
        )
        self.may, self.server = Event(), LiveServer(self.live)
        self.thread = Thread(target=self._work)
        self.stop_after = 6

    def _work(self):
        with self.server:
            execute(self.prepared, on_progress=self._wait)

    def _wait(self, progress):
        self.live.add(progress)
        if progress.done == self.stop_after:
            self.may.wait(60)


@pytest.fixture
def watched(tmp_path):
    run = Watched(tmp_path)
    run.thread.start()
    yield run
    run.may.set()
    run.thread.join()


def count(page):
    return int(page.text("count").split()[0] or 0)


@pytest.mark.parametrize("size", SIZES)
def test_progress_grows_and_the_last_state_stays(page, watched, size, tmp_path):
    page.open(watched.server.address, size)
    page.wait("document.getElementById('count').textContent.startsWith('6 of 8')")
    page.shoot(tmp_path / "running.png")
    assert page.text("title") == "runs/<i>x</i>"
    assert "running" in page.text("state")

    watched.may.set()
    page.wait("document.getElementById('count').textContent.startsWith('8 of 8')")
    watched.thread.join()

    for mode in ("light", "dark"):
        page.prefer(mode)
        assert page.run(FAINT) == []
    page.shoot(tmp_path / "finished.png")
    assert "finished" in page.text("state")
    assert page.run("document.querySelectorAll('#scores tbody tr').length") == 2
    assert page.run("document.querySelectorAll('#scores .planner svg').length") == 2
    low, mean, high = page.run(
        """(() => {
          const row = document.querySelector("#scores tbody tr");
          const [low, high] = row.cells[3].textContent.split(" – ").map(Number);
          return [low, Number(row.cells[2].textContent), high];
        })()"""
    )
    assert 0.0 <= low <= mean <= high <= 100.0
    assert page.run("document.documentElement.scrollWidth") <= size[0]


def test_a_replay_of_the_worst_opens_while_the_run_goes_on(page, watched):
    page.open(watched.server.address)
    link = """document.querySelector("#worst a")"""
    page.wait(link)
    token = page.run(f"{link}.textContent")

    page.open(page.run(f"{link}.href"))

    assert page.text("token") == token
