import inspect
import sys

import pytest

from shiftsim.errors import ConfigError
from shiftsim.planners.registry import PLANNERS, load_planner, planner_factory, planner_fingerprint

OWN = """
class Own:
    def __init__(
        self, gain: float = 1.0, *, loud: bool = False, steps: int | None = None, note="a"
    ):
        self.values = (gain, loud, steps, note)
    def reset(self, scene): ...
    def plan(self, observation): ...

class NoPlan:
    def reset(self, scene): ...
"""


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "own_planner_module.py").write_text(OWN)
    yield tmp_path / "own_planner_module.py"
    sys.modules.pop("own_planner_module", None)


@pytest.mark.parametrize("entry", PLANNERS.values(), ids=list(PLANNERS))
def test_the_registry_tells_the_truth_about_names_and_arguments(entry):
    factory = planner_factory(entry.name)
    assert factory.name == entry.name
    assert tuple(inspect.signature(factory).parameters) == entry.arguments


def test_an_unknown_name_is_answered_with_the_nearest_and_all_others():
    with pytest.raises(ConfigError, match="planner 'imd' unknown") as caught:
        load_planner("imd")
    wanted = "did you mean 'idm'? available: carl, constant-velocity, diffusion-planner, idm,"
    assert caught.value.hint.startswith(wanted)


@pytest.mark.parametrize(
    ("spec", "arguments", "message"),
    [
        ("idm", {"gap": "1"}, "no argument 'gap'"),
        ("idm", {"min_gap": "near"}, "argument min_gap='near' is not a float"),
        ("idm", {"min_gap": True}, "argument min_gap=True is not a float"),
        ("scripted", {}, "needs the argument 'file'"),
        ("no_such_module_at_all:Planner", {}, "cannot be imported"),
        ("own_planner_module:Mine", {}, "has no class 'Mine'"),
        ("own_planner_module:NoPlan", {}, r"NoPlan has no method plan\(\)"),
        ("own_planner_module:Own", {"steps": "1.5"}, "steps='1.5' is not a int"),
        ("own_planner_module:Own", {"loud": "maybe"}, "loud='maybe' is not a bool"),
        ("a:b:c", {}, "not of the form package.module:Class"),
        (":Own", {}, "not of the form package.module:Class"),
    ],
)
def test_what_cannot_be_loaded_says_why(own_module, spec, arguments, message):
    with pytest.raises(ConfigError, match=message):
        load_planner(spec, arguments)


def test_a_forgotten_prefix_of_nuplan_is_named(tmp_path, monkeypatch):
    (tmp_path / "odd.py").write_text("raise ModuleNotFoundError('none', name='nuplan.planning')")
    monkeypatch.chdir(tmp_path)
    for spec in ("odd:Base", "./odd.py:Base"):
        with pytest.raises(ConfigError, match="cannot be imported") as caught:
            load_planner(spec)
        assert f"nuplan:{spec}" in caught.value.hint


def test_a_planner_may_be_named_by_its_file(own_module, tmp_path):
    for spec in ("./own_planner_module.py:Own", f"{own_module}:Own"):
        assert load_planner(spec, {"gain": 2}).values == (2, False, None, "a")
    package = tmp_path / "made" / "inner"
    package.mkdir(parents=True)
    for folder in (package, package.parent):
        (folder / "__init__.py").touch()
    (package / "gain.py").write_text("GAIN = 5.0")
    text = OWN.replace("gain: float = 1.0", "gain: float = GAIN")
    (package / "mine.py").write_text(f"from .gain import GAIN\n{text}")
    assert load_planner("made/inner/mine.py:Own").values[0] == 5.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\nlanes = {}\nlanes['no']", r"KeyError: 'no' \(.*own_planner_module.py:3\)"),
        ("def f(:", "SyntaxError: invalid syntax"),
        (OWN.replace("self.values =", "len(gain);"), r"cannot be made: TypeError: .*module.py:6\)"),
    ],
)
def test_a_module_that_fails_is_one_clear_line(own_module, text, message):
    own_module.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        load_planner("./own_planner_module.py:Own")
    assert caught.value.hint
    assert "\n" not in caught.value.message


def test_a_file_with_the_name_of_a_module_must_be_renamed(tmp_path):
    (tmp_path / "json.py").write_text(OWN)
    with pytest.raises(ConfigError, match="rename the file"):
        load_planner(f"{tmp_path / 'json.py'}:Own")
    with pytest.raises(ConfigError, match="there is no file"):
        load_planner(f"{tmp_path / 'jason.py'}:Own")


def test_texts_become_what_the_constructor_asks_for(own_module):
    texts = {"gain": "2", "loud": "true", "steps": "3", "note": "7"}
    assert load_planner("own_planner_module:Own", texts).values == (2.0, True, 3, "7")


def test_the_fingerprint_follows_arguments_and_source(own_module):
    spec = "own_planner_module:Own"
    before = planner_fingerprint(spec, {"gain": "2"})
    assert before == planner_fingerprint(spec, {"gain": 2})
    assert before != planner_fingerprint(spec, {"gain": 3})
    own_module.write_text(OWN + "# changed\n")
    assert before != planner_fingerprint(spec, {"gain": 2})


def test_the_fingerprint_follows_the_content_of_a_file_argument(tmp_path):
    file = tmp_path / "scripts.csv"
    file.write_text("a")
    before = planner_fingerprint("scripted", {"file": str(file)})
    file.write_text("b")
    assert before != planner_fingerprint("scripted", {"file": str(file)})
    file.unlink()
    with pytest.raises(ConfigError, match="cannot be read"):
        planner_fingerprint("scripted", {"file": str(file)})
