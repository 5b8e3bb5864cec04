"""Comparison with outputs of official code: on any folder, or on the copies in tests/golden.

`python -m pytest tests/parity --reference DIR` compares one reference folder, or several that lie
in DIR; without it what the repository keeps is compared, and the folders of ../shared beside it
where they exist. A test of the mark `reference` is called for every folder of its kind, one of the
mark `files` for every file of these that its patterns match.
"""

import json
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import places
import pytest
from parity_cases import (
    COMPARED_APART,
    COMPARED_ELSEWHERE,
    KINDS,
    NETS,
    Cases,
    open_scenes,
    recognise,
)

from shiftsim.verify.report import Quantity

HERE = Path(__file__).parent
SHARED = places.REPOSITORY.parent / "shared"
GOLDEN = [
    *("dynamics", "idm_worlds", "metric_worlds", "nuplan.tar.xz", "nuplan_experiment", "pdm"),
    *("nuplan_format", "planners", "scenario_edits", *(f"nets/{part}" for part in NETS)),
]
MAX_MISMATCHES = 50


def pytest_addoption(parser: pytest.Parser) -> None:
    """Where the references are."""
    group = parser.getgroup("parity", "comparison with outputs of official code")
    group.addoption("--reference", type=Path, help="folder of reference outputs, or of several")
    group.addoption("--maps", type=Path, help="OpenDRIVE maps that the references are of")
    group.addoption("--scenes", type=Path, help="nuplan folder with logs and maps of the scenes")
    group.addoption("--mode", choices=("NR", "R", "PT"), help="only runs of this mode")


def option(config: pytest.Config, name: str) -> Any:
    """An option, None where pytest was not called with this folder."""
    return config.getoption(f"--{name}", default=None)


def references(config: pytest.Config) -> list[tuple[str, Path, bool]]:
    """Kind and place of every reference folder, and whether it is a large one."""
    if folder := option(config, "reference"):
        if not folder.is_dir():
            raise pytest.UsageError(f"{folder}: no such folder")
        found = recognise(folder) or [
            pair for path in sorted(folder.iterdir()) if path.is_dir() for pair in recognise(path)
        ]
        return [(kind, path, False) for kind, path in found]
    golden = [places.GOLDEN / name for name in GOLDEN]
    small = [("nuplan", path) for path in golden if path.suffix == ".xz"]
    small += [pair for path in golden if path.is_dir() for pair in recognise(path)]
    large = SHARED / "reference"
    paths = sorted(large.iterdir()) if large.is_dir() else []
    paths = [path for path in paths if path.is_dir() and path.name not in COMPARED_APART]
    found = [pair for path in paths for pair in recognise(path)]
    return [*((*pair, False) for pair in small), *((*pair, True) for pair in found)]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test per folder of its kind, or per file that its patterns match."""
    mark = metafunc.definition.get_closest_marker("reference")
    if mark is None or not {"folder", "path"} & set(metafunc.fixturenames):
        return
    wanted = metafunc.definition.get_closest_marker("files")
    params = []
    for kind, folder, is_large in references(metafunc.config):
        if kind not in mark.args:
            continue
        paths = [folder]
        if wanted is not None:
            paths = [
                path
                for path in sorted(folder.iterdir())
                if any(fnmatch(path.name, pattern) for pattern in wanted.args)
            ]
        marks = [pytest.mark.thorough] if is_large else []
        name = ("shared/" if is_large else "") + folder.name.partition(".")[0]
        params += [
            pytest.param(p, marks=marks, id=name if p == folder else f"{name}/{p.name}")
            for p in paths
        ]
    argument = "folder" if wanted is None else "path"
    metafunc.parametrize(argument, params, indirect=argument == "folder")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """With a folder given, only what compares it is run."""
    if option(config, "reference") is None:
        return
    others = [
        item
        for item in items
        if HERE in item.path.parents
        and (item.get_closest_marker("reference") is None or not _takes_reference(item))
    ]
    items[:] = [item for item in items if item not in others]
    config.hook.pytest_deselected(items=others)


def _takes_reference(item: pytest.Item) -> bool:
    """Whether a test is called with a folder or a file of references."""
    params = item.callspec.params if hasattr(item, "callspec") else {}
    return bool({"folder", "path"} & set(params))


@pytest.fixture
def folder(request: pytest.FixtureRequest) -> Path:
    """A reference folder, unpacked."""
    is_packed = request.param.suffix == ".xz"
    return request.getfixturevalue("nuplan_reference") if is_packed else request.param


@pytest.fixture
def cases(request: pytest.FixtureRequest) -> Cases:
    """Receives what the test compares; a mismatch fails it."""
    return Cases(mode=option(request.config, "mode"))


@pytest.fixture
def scenes_folder(request: pytest.FixtureRequest) -> Path:
    """Where the logs and maps of the scenes are: as said, beside the reference, or golden."""
    if given := option(request.config, "scenes"):
        return given
    place = request.node.callspec.params.get("path") or request.node.callspec.params["folder"]
    if places.GOLDEN in place.parents:
        return request.getfixturevalue("nuplan_reference")
    own = place if place.is_dir() else place.parent
    if any(own.glob("*.db")):
        return own
    nearby = [parent / "nuplan" for parent in place.resolve().parents]
    return next((path for path in nearby if (path / "scenes.json").is_file()), nearby[0])


@pytest.fixture
def scenes(scenes_folder: Path) -> Any:
    """The scenes of nuPlan's formats that other references refer to."""
    return open_scenes(scenes_folder)


@pytest.fixture
def maps(request: pytest.FixtureRequest) -> Path:
    """Folder with OpenDRIVE maps."""
    if given := option(request.config, "maps"):
        return given
    place = request.node.callspec.params.get("path") or request.node.callspec.params["folder"]
    nearby = [parent / "maps" for parent in place.resolve().parents[1:5]]
    return next((path for path in nearby if path.is_dir()), SHARED / "maps")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[Any]:
    """Fail a test with mismatches, and hand on what it has compared."""
    cases = getattr(item, "funcargs", {}).get("cases")
    try:
        result = yield
    except Exception as error:
        if cases is not None:
            cases.fail(item.name, "raised", f"{type(error).__name__}: {error}")
        raise
    finally:
        if cases is not None:
            rows = {
                name: [q.cases, q.mismatches, q.max_error, q.tolerance]
                for name, q in cases.quantities.items()
            }
            parts = [rows, cases.mismatches, cases.not_covered, cases.informative]
            item.user_properties.append(("cases", json.dumps(parts)))
    if cases is not None and cases.mismatches:
        pytest.fail("\n".join(cases.mismatches[:MAX_MISMATCHES]), pytrace=False)
    if cases is not None and cases.not_covered and option(item.config, "reference") is None:
        pytest.fail(f"not covered: {', '.join(cases.not_covered)}", pytrace=False)
    return result


class Total:
    """Adds up what all tests have compared, and prints it."""

    def __init__(self, config: pytest.Config) -> None:
        self.cases, self.config = Cases(), config

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add one test, perhaps of another process."""
        if report.when != "call":
            return
        for name, value in report.user_properties:
            if name == "cases":
                quantities, mismatches, not_covered, informative = json.loads(str(value))
                for label, (count, bad, error, tolerance) in quantities.items():
                    tally = self.cases.quantities.setdefault(label, Quantity())
                    tally.cases += count
                    tally.mismatches += bad
                    tally.max_error = max(tally.max_error, error)
                    tally.tolerance = max(tally.tolerance, tolerance)
                self.cases.mismatches += mismatches
                for what, count in not_covered.items():
                    self.cases.skip(what, count)
                for what in informative:
                    self.cases.note(what)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Nothing compared is a failure; what no test knows is named."""
        folder = option(self.config, "reference")
        known = {path for _, path, _ in references(self.config)}
        if folder not in known and not recognise(folder):
            for path in sorted(folder.iterdir()):
                if path.is_dir() and not recognise(path):
                    if why := COMPARED_ELSEWHERE.get(path.name):
                        self.cases.note(f"{path.name}: {why}")
                    else:
                        self.cases.skip(f"{path.name}: no comparison yet")
        if not self.cases.num_cases:
            session.exitstatus = 1

    def pytest_unconfigure(self) -> None:
        """Print the report; its last line is the last one."""
        if not self.cases.num_cases:
            print(f"known kinds of folders: {', '.join([*KINDS, *NETS])}")
        print("\n".join(self.cases.lines()))


def pytest_configure(config: pytest.Config) -> None:
    """Sum up in the process that the user started."""
    if option(config, "reference") is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Total(config))
