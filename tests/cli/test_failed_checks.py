"""Commands that read a store name the maps in it that failed checks when they were made."""

import json
import shutil

import pytest

from shiftsim.cli import main


@pytest.fixture
def store(toy, tmp_path):
    """The toy store with the reports of two maps, one of which failed checks."""
    store = shutil.copytree(toy, tmp_path / "store")
    manifest = json.loads((store / "store.json").read_text())
    failed = {"failed check: lanes that kink": 2, "gap": 1, "failed check: lanes apart": 1}
    for name, warnings in {"old%2Etown": failed, "new": {"gap": 3}}.items():
        path = store / f"reports/{name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps({"map_warnings": warnings}))
        manifest["files"][f"reports/{name}.json"] = 64 * "0"
    (store / "store.json").write_text(json.dumps(manifest))
    return store


@pytest.mark.parametrize(
    "words", [["stats"], ["split", "--out", "s.toml"], ["run", "--planner", "idm", "--dry-run"]]
)
def test_a_command_prints_one_line_per_map_with_failed_checks(
    words, store, capsys, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    place = ["--store", str(store)] if words[0] == "run" else [str(store)]
    with pytest.raises(SystemExit) as left:
        main([words[0], *place, *words[1:]])
    assert left.value.code == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "failed check" in line]
    report = store / "reports/old%2Etown.json"
    assert lines == [
        f"map old.town: 3 failed checks, the first: lanes that kink (2); all in {report}"
    ]


def test_a_damaged_report_is_named(store, capsys):
    (store / "reports/new.json").write_text("[]")
    with pytest.raises(SystemExit) as left:
        main(["stats", str(store)])
    assert left.value.code == 2
    assert "reports/new.json: damaged" in capsys.readouterr().err
