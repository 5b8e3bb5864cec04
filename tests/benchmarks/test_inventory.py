"""What is there of a benchmark's data, and what is missing."""

import json

import pytest
from commands import call
from made_runs import write_run
from stores import write_toy_store

from shiftsim.benchmarks import TRACKS, inventory, known_sets, load_track
from shiftsim.report.groups import KnownSet, read_groups, token_digest


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("SHIFTSIM_DATA", str(tmp_path / "stores"))
    monkeypatch.setenv("SHIFTSIM_CHECKPOINTS", str(tmp_path / "checkpoints"))
    return tmp_path


def rows(**wanted):
    found = inventory.list_available_data()["rows"]
    return [row for row in found if all(row[name] == value for name, value in wanted.items())]


def test_where_nothing_is_there_every_row_names_what_to_get(place):
    found = inventory.list_available_data()
    assert found["stores"] == []
    assert len(found["rows"]) == 26
    [row] = rows(track="state-drift", planner="diffusion-planner")
    assert [lack["what"] for lack in row["missing"]] == [
        "Val14 (1118 scenarios)",
        "own scenarios",
        "planner diffusion-planner",
    ]
    assert row["missing"][0]["get"].startswith("shiftsim convert nuplan ")
    assert row["missing"][1]["get"].startswith("shiftsim convert dsc3d ")
    assert "ZhengYinan-AIR/Diffusion-Planner" in row["missing"][2]["get"]


def test_a_store_of_ones_own_and_a_checkpoint_are_found(place):
    store = write_toy_store(place / "stores" / "toy")
    (store / "splits").mkdir()
    (store / "splits" / "half.toml").write_text('tokens = ["toy-1"]')
    token = inventory.open_store(store).tokens[0]
    (store / "splits" / "half.toml").write_text(f'tokens = ["{token}"]')
    (store / "splits" / "other.toml").write_text('tokens = ["not-here"]')
    (place / "checkpoints").mkdir()
    (place / "checkpoints" / "planTF.ckpt").touch()
    [found] = inventory.list_available_data()["stores"]
    assert [(one["name"], one["scenarios"]) for one in found["sets"]] == [
        ("toy", 4),
        ("toy:half", 1),
    ]
    assert found["maps"]
    for row in rows(planner="plantf"):
        assert row["own"] == ([] if row["track"] == "finding" else ["toy", "toy:half"])
        lacks = {lack["what"] for lack in row["missing"]} - {"planner plantf"}  # without torch
        listed = row["track"] in ("semantic-shift", "state-drift")
        assert lacks == ({"Val14 (1118 scenarios)"} if listed else set())


def test_the_published_list_is_known_by_its_tokens(place, monkeypatch):
    tokens = inventory.open_store(write_toy_store(place / "stores" / "mine")).tokens
    mine = KnownSet("val14", "Val14", "nuplan", len(tokens), token_digest(tokens))
    others = tuple(one for one in known_sets() if one.name != "val14")
    monkeypatch.setattr(inventory, "known_sets", lambda: (mine, *others))
    [row] = rows(track="semantic-shift", planner="pdm-closed")
    assert (row["reference"], row["own"]) == ("mine", [])
    assert [lack["what"] for lack in row["missing"]] == ["own scenarios"]


def test_a_damaged_store_is_named_and_the_others_are_listed(place):
    write_toy_store(place / "stores" / "toy")
    broken = write_toy_store(place / "stores" / "broken")
    (broken / "store.json").write_text("{")
    first, second = inventory.list_available_data()["stores"]
    assert "store.json" in first["problem"]
    assert (second["name"], second["problem"]) == ("toy", "")


@pytest.mark.thorough
def test_the_command_prints_the_same_as_data_and_as_text(place):
    write_toy_store(place / "shiftsim-data" / "toy")
    printed = call(place, "data")
    assert printed.returncode == 0, printed.stderr
    assert "toy                4 scenarios" in printed.stdout
    assert "state-drift     pdm-closed         missing          toy " in printed.stdout
    assert "Val14 (1118 scenarios): shiftsim convert nuplan" in printed.stdout
    found = json.loads(call(place, "data", "--json").stdout)
    assert [store["name"] for store in found["stores"]] == ["toy"]
    assert {row["track"] for row in found["rows"]} == {*TRACKS}


def test_windows_of_all_lengths_count_as_one_set(tmp_path):
    lost = [("alpha", "none", 0, "t1")]
    rules = {"durations": ("15 s", "8 s", "8 s", "15 s"), "thresholds": "deepplan"}
    run = write_run(tmp_path / "a", missing=lost, split="cities", **rules)
    table = inventory.coverage(load_track("semantic-shift"), read_groups([run]))
    [row] = [row for row in table.rows if row[0] == "cities"]
    assert (row[1], row[2].value, row[3].value, row[4]) == ("alpha", 3, 8, "partial (3/8)")
    assert table.notes[-1].startswith("planners of the track that are not here: ")
