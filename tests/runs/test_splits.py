"""Splits name scenarios."""

import json
import shutil

import pytest

from shiftsim.data.store.reading import open_store
from shiftsim.errors import ConfigError
from shiftsim.runs.config import RunConfig
from shiftsim.runs.edited import make_edits
from shiftsim.runs.scenarios import (
    choose_scenarios,
    default_split,
    find_split,
    read_split,
    select_scenarios,
    token_hash,
    write_split,
)

TOKENS = ("a1", "b2", "c3")


def test_the_store_itself_is_a_split(tmp_path):
    store = tmp_path / "mini"
    assert find_split("", store, TOKENS).tokens == TOKENS
    assert find_split("mini", store, TOKENS).name == "mini"


def test_a_split_of_the_store_is_found_by_name(tmp_path):
    (tmp_path / "splits").mkdir()
    (tmp_path / "splits" / "small.toml").write_text('tokens = ["a1"]')
    assert find_split("small", tmp_path, TOKENS).tokens == ("a1",)
    with pytest.raises(ConfigError, match="split 'smal' unknown") as caught:
        find_split("smal", tmp_path, TOKENS)
    assert "did you mean 'small'" in caught.value.hint


def test_a_list_of_tokens_is_a_split(tmp_path):
    path = tmp_path / "list.txt"
    path.write_text("a1\nb2\n")
    assert read_split(path).tokens == ("a1", "b2")
    assert read_split(path).name == "list"


def test_the_hash_does_not_depend_on_the_order():
    assert token_hash(["a", "b"]) == token_hash(["b", "a"]) != token_hash(["a", "c"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lists no tokens"),
        ("tokens = []", "lists no tokens"),
        ("tokens = [1]", "lists no tokens"),
        ('tokens = ["a", "b", "a"]', "lists 'a' twice"),
        ('tokens = ["a"]\ncount = 2', "says count = 2, but it is 1"),
        ('tokens = ["a"]\nhash = "00"', "says hash"),
    ],
)
def test_a_split_that_contradicts_itself_is_refused(tmp_path, text, message):
    path = tmp_path / "split.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_split(path)


ROWS = [
    {"token": "c", "type": "left", "city": "town"},
    {"token": "a", "type": "left", "city": "town"},
    {"token": "b", "type": "right", "city": "port"},
    {"token": "d", "type": "right", "city": "town"},
]


@pytest.mark.parametrize(
    ("asked", "tokens"),
    [
        ({"wanted": {}}, ("a", "b", "c", "d")),
        ({"wanted": {"type": ["left"], "city": []}}, ("a", "c")),
        ({"wanted": {"type": ["left", "right"], "city": ["port"]}}, ("b",)),
        ({"wanted": {}, "per_type": 1}, ("a", "b")),
        ({"wanted": {"city": ["town"]}, "limit": 2}, ("a", "c")),
    ],
)
def test_scenarios_are_chosen_by_type_city_and_number(asked, tokens):
    assert choose_scenarios(ROWS, "abcd", **asked) == tokens
    assert choose_scenarios(ROWS[::-1], "abcd", **asked) == tokens


def test_only_usable_scenarios_are_chosen_and_counted():
    assert choose_scenarios(ROWS, "bc", wanted={}, per_type=1) == ("b", "c")


def test_a_value_that_no_scenario_has_is_refused():
    with pytest.raises(ConfigError, match="type 'lef' unknown") as caught:
        choose_scenarios(ROWS, "abcd", wanted={"type": ["lef"]})
    assert "left" in caught.value.hint


@pytest.mark.parametrize("suffix", [".toml", ".txt"])
def test_a_written_split_is_read_back(tmp_path, suffix):
    path = tmp_path / "new" / f'my "own"{suffix}'
    written = write_split(path, TOKENS)
    assert read_split(path) == written
    assert written.tokens == TOKENS


def test_a_split_that_was_cut_off_is_refused(tmp_path):
    path = tmp_path / "half.toml"
    write_split(path, TOKENS)
    path.write_text(path.read_text().replace(f'    "{TOKENS[-1]}",\n', ""))
    with pytest.raises(ConfigError, match="says count"):
        read_split(path)


@pytest.mark.parametrize(("name", "tokens"), [("a.csv", TOKENS), ("a.toml", ())])
def test_nothing_is_written_that_could_not_be_read(tmp_path, name, tokens):
    with pytest.raises(ConfigError):
        write_split(tmp_path / name, tokens)
    assert not (tmp_path / name).exists()


@pytest.fixture
def demo(toy, tmp_path):
    """A store that says it is the generated demo, whose split `demo-mini` has two scenarios."""
    folder = shutil.copytree(toy, tmp_path / "demo")
    manifest = json.loads((folder / "store.json").read_text())
    (folder / "store.json").write_text(json.dumps(manifest | {"generator": {"name": "demo"}}))
    tokens = open_store(folder).tokens
    write_split(folder / "splits/demo-mini.toml", tokens[:2])
    return open_store(folder)


def edits_of(*tokens):
    spawn = {"at": {"ahead_m": 40, "left_m": 1.5}, "behavior": "stopped"}
    listed = [{"name": f"van{i}", "tokens": [t], "spawn": spawn} for i, t in enumerate(tokens)]
    return make_edits({"edit": listed}, "vans")


def test_where_no_split_is_named_the_demo_is_its_own_split(demo, toy):
    settings = {"planners": ("idm",), "store": str(demo.path)}
    found = select_scenarios(RunConfig(**settings), demo)
    assert (found.split, tuple(found.present)) == ("demo-mini", demo.tokens[:2])
    left = len(demo) - 2
    words = f"{left} of {len(demo)} scenarios, not in split demo-mini (--split demo takes all)"
    assert found.left_out == [words]
    whole = select_scenarios(RunConfig(**settings, split="demo"), demo)
    assert (tuple(whole.present), whole.left_out) == (demo.tokens, [])
    assert default_split(open_store(toy)) == ""


def test_a_limited_run_knows_the_size_of_its_split(demo):
    config = RunConfig(planners=("idm",), store=str(demo.path), split="demo", limit=1)
    assert select_scenarios(config, demo).size == len(demo)


def test_edits_of_other_scenarios_are_driven_or_named(demo):
    inside, outside = demo.tokens[0], demo.tokens[-1]
    settings = {"planners": ("idm",), "store": str(demo.path)}
    both = edits_of(inside, outside)
    assert default_split(demo, edits_of(inside)) == "demo-mini"
    assert len(select_scenarios(RunConfig(**settings), demo, both).present) == 2
    found = select_scenarios(RunConfig(**settings, split="demo-mini"), demo, both)
    assert found.present == [f"{inside}-van0"]
    lost = f"{outside}-van1"
    assert found.left_out == [f"1 of 2 edited scenarios, not made of split demo-mini: {lost}"]
