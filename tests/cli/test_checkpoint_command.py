"""`shiftsim checkpoint` and `shiftsim planners` through the real command line."""

import importlib.util
import json
import os
import subprocess
import sys

import pytest

if importlib.util.find_spec("torch") is None:
    pytest.skip("needs torch", allow_module_level=True)

from checkpoint_files import LEARNED, Callback, lightning_entries, save, state_of, write_published

from shiftsim.planners.learned.checkpoint import load_weights
from shiftsim.planners.table import shipped_file

pytestmark = [pytest.mark.learned, pytest.mark.slow, pytest.mark.thorough]


def call(folder, *words):
    environment = os.environ | {"COLUMNS": "200", "SHIFTSIM_CHECKPOINTS": str(folder / "mine")}
    return subprocess.run(
        [sys.executable, "-m", "shiftsim", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a checkpoint of PlanTF that holds more than tensors."""
    folder = tmp_path_factory.mktemp("place")
    entries = {**lightning_entries(state_of("plantf")), "callbacks": Callback()}
    save(entries, folder / "planTF.ckpt")
    return folder


def test_inspect_says_what_a_file_is(place):
    done = call(place, "checkpoint", "inspect", "planTF.ckpt")
    assert done.returncode == 0, done.stderr
    for line in (
        "container   torch zip, state_dict",
        "looks like  plantf",
        "loads       yes",
        "tensors     218, 2024047 values",
    ):
        assert line in done.stdout
    assert "checkpoint_files.Callback" in done.stdout


def test_inspect_prints_json(place):
    done = call(place, "checkpoint", "inspect", "planTF.ckpt", "--json")
    found = json.loads(done.stdout)
    assert (found["planner"], found["tensors"], found["problem"]) == ("plantf", 218, "")
    assert len(found["sha256"]) == 64


def test_inspect_shows_the_args_of_diffusion_planner(place):
    write_published(place / "dp", "diffusion-planner", state_of("diffusion-planner"))
    done = call(place, "checkpoint", "inspect", "dp", "--json")
    found = json.loads(done.stdout)
    assert found["container"] == "torch zip, ema_state_dict"
    assert (found["planner"], found["args"]["lane_num"]) == ("diffusion-planner", 70)


def test_convert_writes_what_loads_equally(place):
    done = call(place, "checkpoint", "convert", "planTF.ckpt", "made.safetensors")
    assert done.returncode == 0, done.stderr
    assert "container   safetensors" in done.stdout
    assert "made from   sha256 " in done.stdout
    made, source = (
        load_weights(str(place / name), "plantf").state
        for name in ("made.safetensors", "planTF.ckpt")
    )
    assert all((made[name] == source[name]).all() for name in source)


@pytest.mark.parametrize(
    ("words", "fact", "hint"),
    [
        (("inspect", "absent.ckpt"), "checkpoint 'absent.ckpt' does not exist", "check the path"),
        (("convert", "planTF.ckpt", "a.pth"), "cannot write 'a.pth'", "name it"),
        (("inspect", "page.ckpt"), "is a web page: the download has failed", ""),
        (("inspect", "own.pth"), "its tensors in the entry 'net', not in one of", "(FILE)['net']"),
        (("convert", "own.safetensors", "own.safetensors"), "is the checkpoint itself", "another"),
        (("convert", "other.pth", "a.safetensors"), "is of no planner known here", "inspect"),
    ],
)
def test_what_cannot_be_done_is_two_lines(place, words, fact, hint):
    import torch

    (place / "page.ckpt").write_text("<html>")
    from safetensors.torch import save_file

    save({"a": torch.ones(2)}, place / "other.pth")
    save({"epoch": 3, "net": {"a": torch.ones(2)}}, place / "own.pth")
    save_file({"a": torch.ones(2)}, place / "own.safetensors")
    done = call(place, "checkpoint", *words)
    assert done.returncode == 1
    assert fact in done.stderr
    assert hint in done.stderr
    assert "Traceback" not in done.stderr


def test_planners_says_what_is_wanted_and_what_is_ready(place):
    done = call(place, "planners")
    assert done.returncode == 0, done.stderr
    own = {name: shipped_file(name) is not None for name in LEARNED}
    wanted = "planTF.ckpt (weights of 8 MB) from the project jchengai/planTF"
    assert wanted in done.stdout
    assert (
        f"no checkpoint: give one, or put it at {place / 'mine' / 'diffusion-planner'}"
        in done.stdout
    )
    assert f"{6 + sum(own.values())} of 10 are ready to run" in done.stdout
    (place / "mine").mkdir()
    (place / "mine" / "planTF.ckpt").symlink_to(place / "planTF.ckpt")
    rows = {row["name"]: row for row in json.loads(call(place, "planners", "--json").stdout)}
    assert rows["plantf"]["ready"]
    own["plantf"] = True
    assert {name: rows[name]["ready"] for name in LEARNED} == own
    assert rows["carl"]["checkpoint"]["project"] == "autonomousvision/CaRL"
    assert (
        f"{6 + sum(own.values())} of 10 are ready to run" in call(place, "planners", "list").stdout
    )
