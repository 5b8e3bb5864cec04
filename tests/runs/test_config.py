"""Settings are checked when they are read."""

import json
from pathlib import Path

import pytest

from shiftsim.errors import ConfigError
from shiftsim.files import read_toml, store_path
from shiftsim.runs.config import make_config, parse_argument, parse_seeds, split_label

GOOD = {"planners": ["idm", "my.module:Mine"], "noise": ["ou-high"], "seeds": [0, 2]}


def test_settings_survive_as_plain_values():
    arguments = {"idm": {"min_gap": 1.5, "name": 'a "quoted" \\ name', "on": True, "list": [1, 2]}}
    config = make_config({**GOOD, "planner_args": arguments, "limit": 3, "out": "runs/ü"})
    assert make_config(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("values", "message", "hint"),
    [
        ({}, "no planner", "--planner"),
        ({"planner": ["idm"]}, "key 'planner' unknown", "did you mean 'planners'?"),
        ({**GOOD, "noize": ["none"]}, "key 'noize' unknown", "did you mean 'noise'?"),
        ({"planners": "idm"}, "must be a list", ""),
        ({"planners": []}, "no planner", "--planner"),
        ({"planners": ["idm", "idm"]}, "listed twice", "--planner LABEL=PLANNER"),
        ({"planners": ["a=idm", "a=simple"]}, "listed twice", "--planner LABEL=PLANNER"),
        ({"planners": ["=idm"]}, "'=idm' is not LABEL=PLANNER", "--planner ours=idm"),
        ({"planners": ["ours="]}, "'ours=' is not LABEL=PLANNER", "--planner ours=idm"),
        ({"planners": ["a=idm"], "planner_args": {"idm": {}}}, "'idm' unknown", "available: a"),
        ({**GOOD, "seeds": [1.5]}, "seeds is 1.5; it must be an integer", ""),
        ({**GOOD, "seeds": [True]}, "seeds is True; it must be an integer", ""),
        ({**GOOD, "seeds": [-1]}, "from 0 on", ""),
        ({**GOOD, "limit": "3"}, "limit is '3'; it must be an integer", ""),
        ({**GOOD, "limit": -3}, "must be within 0", ""),
        ({**GOOD, "allow_partial": 1}, "must be true or false", ""),
        ({**GOOD, "save_rollouts": "al"}, "save_rollouts 'al' unknown", "did you mean 'all'?"),
        ({**GOOD, "planner_args": {"idn": {}}}, "'idn' unknown", "did you mean 'idm'?"),
        ({**GOOD, "planner_args": {"idm": 3}}, "planner_args is 3; it must be a table", ""),
    ],
)
def test_a_wrong_setting_is_named(values, message, hint):
    with pytest.raises(ConfigError) as caught:
        make_config(values, where="run.toml")
    assert str(caught.value).startswith("run.toml: ")
    assert message in str(caught.value)
    assert hint in caught.value.hint


def test_a_file_that_is_missing_or_no_toml_is_named(tmp_path):
    broken = tmp_path / "broken.toml"
    broken.write_text("planners = [")
    with pytest.raises(ConfigError, match=r"broken\.toml' is not TOML"):
        read_toml(broken)
    with pytest.raises(ConfigError, match=r"cannot read .*absent\.toml"):
        read_toml(tmp_path / "absent.toml")


@pytest.mark.parametrize(
    ("text", "planners", "expected"),
    [
        ("gap=1.5", ("idm",), ("idm", "gap", 1.5)),
        ("idm.gap=2", ("idm", "simple"), ("idm", "gap", 2)),
        ("file=a/b.csv", ("scripted",), ("scripted", "file", "a/b.csv")),
        ("on=true", ("idm",), ("idm", "on", True)),
        ("m:P.k=v=w", ("m:P", "idm"), ("m:P", "k", "v=w")),
        ("b.gap=2", ("a=idm", "b=m:P"), ("b", "gap", 2)),
    ],
)
def test_planner_arguments_are_read_as_toml_values(text, planners, expected):
    assert parse_argument(text, planners) == expected


@pytest.mark.parametrize("text", ["gap", "=1", "gap=1"])
def test_planner_arguments_must_say_what_and_whose(text):
    with pytest.raises(ConfigError, match="planner argument"):
        parse_argument(text, ("idm", "simple"))


def test_stores_are_found_by_name_or_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert store_path("mini") == Path("shiftsim-data/mini")
    assert store_path("some/where") == Path("some/where")
    for text in ("./mini", "mini/", "../mini"):
        assert store_path(text).resolve() == store_path(store_path(text)).resolve()
        assert store_path(text).resolve() == (tmp_path / text).resolve()
    assert store_path(Path("./mini")) == Path("shiftsim-data/mini")
    monkeypatch.setenv("SHIFTSIM_DATA", "/data")
    assert store_path("mini") == Path("/data/mini")
    (tmp_path / "mini").mkdir()
    (tmp_path / "mini" / "store.json").write_text("{}")
    assert store_path("mini") == Path("mini")


@pytest.mark.parametrize("setting", [{"workers": 10**9}, {"batch_size": 10**9}, {"timeout": 1e300}])
def test_more_than_any_machine_has_is_refused(setting):
    with pytest.raises(ConfigError, match="it must be within"):
        make_config({"planners": ["idm"], **setting})


def test_seeds_are_numbers_or_ranges():
    assert parse_seeds("0,1,2") == [0, 1, 2]
    assert parse_seeds("0-2,7") == [0, 1, 2, 7]
    assert parse_seeds("-1") == [-1]  # which a configuration refuses
    for text in ("a", "1-", "1-b", "", "1,,2", "0-99999999", "3-1"):
        with pytest.raises(ConfigError, match="seeds"):
            parse_seeds(text)


def test_a_label_stands_before_the_planner_and_holds_no_path():
    assert split_label("ours=m:P") == ("ours", "m:P")
    assert split_label("idm") == ("idm", "idm")
    assert split_label("policy:a=b.zip") == ("policy:a=b.zip", "policy:a=b.zip")
