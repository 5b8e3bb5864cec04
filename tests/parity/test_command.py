"""`python -m pytest tests/parity --reference DIR`, and how files of references are read."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import places
import pytest
from parity_cases import Cases, File, Rows, change_array, read_file, recognise

GOLDEN = places.GOLDEN / "dynamics"


def run(folder: Path) -> tuple[int, str]:
    """Exit code and last line."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/parity"]
    done = subprocess.run(
        [*command, "--reference", str(folder)],
        cwd=places.REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout.splitlines()[-1]


@pytest.mark.thorough
def test_a_folder_is_compared_and_its_last_line_sums_up(tmp_path):
    shutil.copy(GOLDEN / "idm_steps.npz", tmp_path)
    code, line = run(tmp_path)
    assert code == 0
    assert line.endswith(" cases covered, 0 mismatches, 0 not covered")
    change_array(GOLDEN / "ego_state_frames.npz", tmp_path / "ego_state_frames.npz", "corners")
    (tmp_path / "novelty.npz").write_bytes(b"")
    code, line = run(tmp_path)
    assert code == 1
    assert line.endswith(" cases covered, 1 mismatches, 1 not covered")


@pytest.mark.slow
@pytest.mark.thorough
def test_nothing_to_compare_is_a_failure(tmp_path):
    (tmp_path / "novelty").mkdir()
    assert run(tmp_path) == (1, "0 cases covered, 0 mismatches, 1 not covered")


def test_folders_are_recognised_by_their_content(tmp_path):
    known = {"dynamics": "dynamics", "nets/pluto": "pluto", "planners": "pdm"}
    for name, kind in known.items():
        assert recognise(places.GOLDEN / name) == [(kind, places.GOLDEN / name)]
    assert recognise(tmp_path) == []


def test_rows_between_two_numbers_of_a_pointer_are_one_case(tmp_path):
    path, cases = tmp_path / "file_07.npz", Cases()
    np.savez(path, x=[1.0, 9.0], line_ptr=[0, 2, 5], line_x=np.arange(5.0))
    for case in read_file(path, cases).cases():
        case.match("case", {"x": case["line_x"].sum()})
    assert (cases.num_cases, cases.mismatches, cases.not_covered) == (2, [], {})
    np.savez(path, x=[1.0, 9.0], line_ptr=[0, 2, 4], line_x=np.arange(5.0))
    with pytest.raises(Exception, match="has 5 rows, which are not those of 2 cases"):
        list(read_file(path, cases).cases())


def test_what_no_comparison_reads_is_named(tmp_path):
    path, cases = tmp_path / "file_07.json", Cases()
    path.write_text(json.dumps([{"x": 1}, {"x": 3, "y": 0}]))
    for case in read_file(path, cases).cases():
        case.match("case", {"x": 1})
    assert cases.mismatches == ["file.json x: case: 1, not 3"]
    assert list(cases.not_covered) == ["file.json: field 'y'"]


def test_angles_are_equal_up_to_whole_turns_and_sets_in_any_order():
    cases = Cases()
    theirs = File("file", "field", {"turn": 0.5 - 2.0 * np.pi, "ids": ["b", "a"]}, cases)
    for turn, names, mismatches in ((0.5, ["a", "b"], 0), (0.6, ["a", "c"], 2)):
        ours = {"turn": turn, "ids": names}
        theirs.match("case", ours, {"turn": 1e-9}, angles=("turn",), unordered=("ids",))
        assert len(cases.mismatches) == mismatches


@pytest.mark.parametrize(
    ("key", "missed"),
    [
        (["scene", "challenge"], ["table: rows of a NR"]),
        (["scene"], ["table: rows of a", "table: rows of b"]),
    ],
)
def test_only_rows_of_runs_are_limited_to_a_mode(key, missed):
    cases = Cases(mode="NR")
    rows = {"scene": ["a", "b"], "challenge": ["NR", "R"]}
    columns = {name: np.array(values, object) for name, values in rows.items()}
    Rows(File("table", "column", columns, cases), key).finish()
    assert list(cases.not_covered) == missed
