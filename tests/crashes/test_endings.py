"""Whatever call to the file system a process dies in, or is refused: nothing is lost.

A shim in C, loaded before everything else so that the writes of Arrow and SQLite count as well,
numbers the calls that change files below one folder (write, rename, sync, remove, …). Every job is
ended at its n-th call, for each n, and started again: the results are those of an undisturbed one.
`make test` tries a few calls of each, `make test-thorough` many, `make test-long` all.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import dsc3d_writer as writer
import numpy as np
import pytest
from stores import write_toy_store

import shiftsim
from shiftsim.runs.filter import RESULTS as VERDICTS

HERE = Path(__file__).parent
KILLS = ("before", "after")  # half of a write arrives, where it dies after the call
ERRORS = ("eio", "eio on", "full")  # one call fails, all from it on do, no space is left from it on
TABLES = ("scores.parquet", "metrics.parquet")

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="the shim is made for Linux"),
    pytest.mark.skipif(shutil.which("gcc") is None, reason="the shim needs gcc"),
]


@dataclass(frozen=True)
class Job:
    """A command that writes a folder, and the one that goes on with it."""

    words: tuple[str, ...]
    again: tuple[str, ...]
    root: str  # the folder, below that of the job
    given: tuple[str, ...] = ()  # folders that it begins with, besides the stores


RUN = (
    "run",
    "-p",
    "moody:Moody",
    "-s",
    "./toy",
    "--noise",
    "ou-high",
    "--seeds",
    "0,1",
    "--quiet",
    "--out",
    "run",
)
ONE = ("--workers", "1")
JOBS = {
    "run": Job((*RUN, *ONE), (*RUN, *ONE, "--resume"), "run"),
    "resume": Job((*RUN, *ONE, "--resume"), (*RUN, *ONE, "--resume"), "run", ("run",)),
    "retry": Job(
        (*RUN, *ONE, "--retry-failed"), (*RUN, *ONE, "--retry-failed"), "run", ("failed",)
    ),
    "bundle": Job((*RUN, *ONE, "--bundle"), (*RUN, *ONE, "--bundle", "--resume"), "run"),
    "two workers": Job((*RUN, "--workers", "2"), (*RUN, *ONE, "--resume"), "run"),
    "merge": Job(*[("merge", "part1", "part2", "--out", "run")] * 2, "run", ("part1", "part2")),
    "score": Job(
        *[("score", "whole", "--thresholds", "deepplan", "--quiet", *ONE, "--out", "run")] * 2,
        "run",
        ("whole",),
    ),
    "filter": Job(*[("filter", "./store", "--quiet", *ONE)] * 2, "store", ("store",)),
    "convert": Job(
        *[("convert", "dsc3d", "./town", "--store", "./made", "--quiet", *ONE)] * 2,
        "shiftsim-data/made",
    ),
}
MOODY = """
import os
from shiftsim.planners.basic import ConstantVelocity

class Moody(ConstantVelocity):
    def reset(self, scene):
        super().reset(scene)
        if os.path.exists("bad-mood") and scene.token == "0001cafe":
            raise RuntimeError("not today")
"""


class Place:
    """A folder with all that the jobs need, and the process that does them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        library = folder / "shim.so"
        build = ["gcc", "-shared", "-fPIC", "-O1", "-o", library, HERE / "shim.c", "-ldl"]
        subprocess.run(build, check=True)
        (folder / "moody.py").write_text(MOODY)
        write_toy_store(folder / "toy", count=2, iterations=10)
        shutil.copytree(folder / "toy", folder / "given" / "store")
        write_town(folder / "town")
        environment = {k: v for k, v in os.environ.items() if k != "SHIFTSIM_DATA"}
        self.process = subprocess.Popen(
            [sys.executable, HERE / "server.py", library],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment | {"LD_PRELOAD": str(library)},
            text=True,
        )
        self._prepare()

    def _prepare(self) -> None:
        given = self.folder / "given"
        for name, more in {
            "whole": ("--resume",),
            "part1": ("--shard", "1/2"),
            "part2": ("--shard", "2/2"),
        }.items():
            assert self.ask((*RUN, *ONE, *more), "warm")["code"] == 0
            os.replace(self.folder / "run", given / name)
        (self.folder / "bad-mood").touch()
        assert self.ask((*RUN, *ONE), "warm")["code"] == 3
        os.replace(self.folder / "run", given / "failed")
        (self.folder / "bad-mood").unlink()
        for name in ("convert", "filter", "merge", "score", "bundle"):
            self.begin(JOBS[name])
            assert self.ask(JOBS[name].words, "warm")["code"] == 0

    def begin(self, job: Job) -> None:
        """Bring the folder into the state before the job."""
        for name in ("run", "shiftsim-data", "store", "part1", "part2", "whole"):
            shutil.rmtree(self.folder / name, ignore_errors=True)
        for name in job.given:
            source = self.folder / "given" / name
            target = self.folder / ("run" if name == "failed" else name)
            if source.exists():
                shutil.copytree(source, target)
        if job is JOBS["resume"]:
            (self.folder / "run").mkdir()
            killed = self.ask(RUN + ONE, "before", 30, "run")
            assert killed["code"] == -9

    def ask(self, words, mode: str, at: int = 0, root: str = "run") -> dict:
        asked = {"words": words, "mode": mode, "at": at, "root": str(self.folder / root)}
        self.process.stdin.write(json.dumps(asked) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def results(self, job: Job) -> dict:
        """What counts in the folder of a job, by name."""
        folder = self.folder / job.root
        if job.root == "run":
            return run_results(folder)
        if job.root == "store":
            assert not list((folder / "filter").glob("unfinished*"))
            return {VERDICTS: (folder / VERDICTS).read_bytes()}
        return {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*")
            if path.is_file() and ".partial" not in path.parts
        }

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait(30)
        self.process.stdout.close()


def write_town(folder: Path) -> None:
    """A site of one recording."""
    times = writer.frame_times(22.0)
    cars = [writer.car(1, times), writer.car(2, times, x0=300.0, y=1.75, speed=-8.0, yaw=np.pi)]
    writer.write_site(folder, cars, 22.0)


def run_results(folder: Path) -> dict:
    """Bytes of the tables, and of the rollouts without the times that the planner took."""
    run = shiftsim.open_run(folder)
    assert run.is_complete
    out = {name: (folder / name).read_bytes() for name in TABLES}
    for task, place in run.rollout_places.items():
        rows = run.rollout_rows(task)
        names = [name for name in rows.schema.names if name != "planning_seconds"]
        out[str(task)] = repr(rows.select(names).to_pylist())
        assert place is not None
    tasks = run.tasks.to_pylist()
    kept = ("planner", "noise", "seed", "token", "status", "error", "scenario_type")
    out["tasks"] = [[row[name] for name in kept] for row in tasks]
    files = {path.name for path in folder.iterdir()} - {"store"}
    assert files == {"manifest.json", "rollouts", "tasks.parquet", *TABLES}
    used = {place.file.name for place in run.rollout_places.values()}
    assert {path.name for path in (folder / "rollouts").iterdir()} == used
    if (folder / "store").exists():
        out["bundle"] = run.manifest["bundle"]["hash"]
    return out


@pytest.fixture(scope="module")
def place():
    shared = "/dev/shm" if os.path.isdir("/dev/shm") else None  # nothing waits for a disk there
    with tempfile.TemporaryDirectory(prefix="crashes-", dir=shared) as folder:
        made = Place(Path(folder))
        yield made
        made.close()


def turning_points(calls: list[str]) -> list[int]:
    """Numbers, from 1 on, of the calls that are not one more write to the file of the last one."""
    return [at for at, call in enumerate(calls, 1) if at == 1 or call != calls[at - 2]]


def every_call(calls: list[str]) -> list[int]:
    return list(range(1, len(calls) + 1))


def try_calls(place: Place, name: str, mode: str, choose) -> None:
    """End a job at each chosen call in turn, and see that it can be finished."""
    job = JOBS[name]
    place.begin(job)
    undisturbed = place.ask(job.words, "count", 0, job.root)
    assert undisturbed["code"] == 0, undisturbed["output"]
    calls = undisturbed["calls"]
    expected = place.results(job)
    wrong = []
    for at in choose(calls):
        place.begin(job)
        ended = place.ask(job.words, mode, at, job.root)
        fault = what_is_wrong(ended, mode)
        if ended["code"] != 0:
            done = place.ask(job.again, "count", 0, job.root)
            if done["code"] != 0:
                fault += f" and again: {done['code']} {done['output']}"
        try:
            if place.results(job) != expected:
                fault += " other results"
        except Exception as error:
            fault += f" {type(error).__name__}: {error}"
        if fault:
            wrong.append(f"call {at}, {calls[at - 1]}: {fault}")
    assert not wrong, f"{len(wrong)} wrong, of {len(calls)} calls:\n" + "\n".join(wrong)


def what_is_wrong(ended: dict, mode: str) -> str:
    """A killed process is dead; another one says in two lines what is wrong, or has succeeded."""
    if mode in KILLS:
        return "" if ended["code"] == -9 else f"survived: {ended['code']} {ended['output']}"
    lines = ended["output"].splitlines()
    if ended["code"] == 0:
        return ""
    told = [line for line in lines if line.startswith("error: ")]
    if ended["code"] in (1, 2) and len(told) == 1 and "Traceback" not in ended["output"]:
        return ""
    return f"ended with {ended['code']}: {ended['output']}"


def some(first: int, step: int):
    """A choice of every `step`-th turning point."""
    return lambda calls: turning_points(calls)[first::step]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "mode"), [("run", "before"), ("run", "full"), ("merge", "eio"), ("filter", "after")]
)
@pytest.mark.thorough
def test_a_job_that_ends_at_some_calls_can_be_finished(place, name, mode):
    try_calls(place, name, mode, some(3, 13))


@pytest.mark.thorough
def test_a_run_that_is_killed_in_its_first_moments_can_be_finished(place):
    try_calls(place, "run", "before", lambda calls: range(1, 8))


@pytest.mark.thorough
@pytest.mark.parametrize("mode", KILLS + ERRORS)
@pytest.mark.parametrize("name", [name for name in JOBS if name != "two workers"])
def test_a_job_that_ends_at_many_calls_can_be_finished(place, name, mode):
    try_calls(place, name, mode, some((KILLS + ERRORS).index(mode), 8))


@pytest.mark.thorough
@pytest.mark.parametrize("mode", ["before", "full"])
def test_a_run_in_two_processes_that_ends_at_some_calls_can_be_finished(place, mode):
    try_calls(place, "two workers", mode, some(7, 12))


@pytest.mark.long
@pytest.mark.parametrize("mode", KILLS + ERRORS)
@pytest.mark.parametrize("name", JOBS)
def test_a_job_that_ends_at_any_call_can_be_finished(place, name, mode):
    try_calls(place, name, mode, every_call)
