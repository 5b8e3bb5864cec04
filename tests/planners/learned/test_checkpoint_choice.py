"""Which checkpoint is meant, what identifies it, and what there is without one."""

import importlib.util
import subprocess
import sys

import pytest

if importlib.util.find_spec("torch") is None:
    pytest.skip("needs torch", allow_module_level=True)

import torch
from checkpoint_files import LEARNED, lightning_entries, save, state_of

from shiftsim.errors import CheckpointError, ConfigError
from shiftsim.planners.learned.checkpoint import (
    checkpoint_fingerprint,
    find_checkpoint,
    load_weights,
    resolve_device,
    split_ensemble,
)
from shiftsim.planners.registry import PLANNERS, load_planner, planner_fingerprint, readiness

pytestmark = [pytest.mark.learned, pytest.mark.usefixtures("checkpoints")]


# --- found by path and by name


def test_a_checkpoint_is_found_by_file_folder_and_name(tmp_path, checkpoints):
    folder = checkpoints / "nuplan_51892_1B"
    folder.mkdir()
    (folder / "model_best.pth").touch()
    (checkpoints / "mine.safetensors").touch()
    assert find_checkpoint(str(folder)) == folder / "model_best.pth"
    assert find_checkpoint("nuplan_51892_1B") == folder / "model_best.pth"
    assert find_checkpoint("mine") == checkpoints / "mine.safetensors"
    with pytest.raises(CheckpointError, match=r"'nuplan_51892_2B' does not exist") as caught:
        find_checkpoint("nuplan_51892_2B")
    assert caught.value.hint == "did you mean 'nuplan_51892_1B'?"


def test_a_folder_with_several_is_ambiguous(tmp_path):
    for name in ("a.ckpt", "b.ckpt"):
        (tmp_path / name).touch()
    with pytest.raises(CheckpointError, match="holds 2 checkpoints") as caught:
        find_checkpoint(str(tmp_path))
    assert "a.ckpt, b.ckpt" in caught.value.hint


@pytest.mark.usefixtures("no_weights_of_our_own")
@pytest.mark.parametrize("planner", LEARNED)
def test_without_a_checkpoint_the_error_says_where_to_get_it(planner):
    with pytest.raises(CheckpointError, match=f"planner '{planner}' needs a checkpoint") as caught:
        load_planner(planner)
    assert PLANNERS[planner].checkpoint.project in caught.value.hint
    assert "deterministic:drive" in caught.value.hint
    assert "no checkpoint" in readiness(PLANNERS[planner])


def test_the_published_file_is_taken_from_the_folder_of_checkpoints(checkpoints):
    path = save(lightning_entries(state_of("plantf")), checkpoints / "planTF.ckpt")
    assert readiness(PLANNERS["plantf"]) == ""
    fingerprint = planner_fingerprint("plantf")
    assert fingerprint["checkpoint"] == checkpoint_fingerprint(str(path), "plantf")


# --- what identifies it


def test_the_fingerprint_follows_the_content_and_not_the_place(tmp_path):
    a, b = tmp_path / "a.pth", tmp_path / "b.pth"
    a.write_bytes(b"1"), b.write_bytes(b"1")
    assert checkpoint_fingerprint(str(a), "carl") == checkpoint_fingerprint(str(b), "carl")
    a.write_bytes(b"22")
    assert checkpoint_fingerprint(str(a), "carl") != checkpoint_fingerprint(str(b), "carl")
    both = checkpoint_fingerprint(f"{a},{b}", "carl")
    assert both.split(",") == [checkpoint_fingerprint(str(p), "carl") for p in (a, b)]


def test_a_folder_of_policies_is_an_ensemble(tmp_path):
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model_best.pth").write_text(name)
    members = [str(tmp_path / name / "model_best.pth") for name in ("a", "b")]
    assert split_ensemble(str(tmp_path)) == tuple(members)
    assert split_ensemble(str(tmp_path / "a")) == (str(tmp_path / "a"),)
    assert split_ensemble("one, two") == ("one", "two")
    both = checkpoint_fingerprint(str(tmp_path), "carl")
    assert both == ",".join(checkpoint_fingerprint(member, "carl") for member in members)


def test_the_fingerprint_of_diffusion_planner_follows_its_args(tmp_path):
    (tmp_path / "model.pth").write_bytes(b"1")
    (tmp_path / "args.json").write_text("{}")
    before = checkpoint_fingerprint(str(tmp_path), "diffusion-planner")
    (tmp_path / "args.json").write_text('{"a": 1}')
    assert before != checkpoint_fingerprint(str(tmp_path), "diffusion-planner")


def test_a_planners_fingerprint_holds_checkpoint_and_device_but_no_path(tmp_path):
    (tmp_path / "a.ckpt").write_bytes(b"1")
    arguments = {"checkpoint": str(tmp_path / "a.ckpt"), "device": "cpu"}
    fingerprint = planner_fingerprint("plantf", arguments)
    assert len(fingerprint["checkpoint"]) == 64
    assert fingerprint["arguments"] == {"device": "cpu"}
    drive = planner_fingerprint("plantf", {"checkpoint": "deterministic:drive"})
    assert drive["checkpoint"] == "deterministic:drive"


# --- deterministic weights


def test_deterministic_weights_are_as_the_references_define_them():
    weights = load_weights("deterministic:base", "plantf")
    first = weights.state["pos_emb.0.weight"].flatten()[:3].tolist()
    assert first == [1.1109812259674072, -0.008459953591227531, -0.6116122007369995]
    assert weights.args is None
    assert checkpoint_fingerprint("deterministic:base", "plantf") == "deterministic:base"


@pytest.mark.parametrize("planner", LEARNED)
def test_the_driving_variant_differs_in_few_tensors(planner):
    base, drive = (load_weights(f"deterministic:{v}", planner).state for v in ("base", "drive"))
    changed = [name for name in base if not torch.equal(base[name], drive[name])]
    assert 0 < len(changed) < 20


def test_an_unknown_variant_is_named():
    with pytest.raises(CheckpointError, match="'deterministic:fast' unknown") as caught:
        load_weights("deterministic:fast", "plantf")
    assert "deterministic:drive" in caught.value.hint


# --- devices, and no torch at all


@pytest.mark.parametrize("name", ["tpu", "cuda:x", "cpu:1", "auto:0", "cuda:99"])
def test_a_device_that_is_not_there_is_an_error(name):
    with pytest.raises(ConfigError, match=f"device '{name}'"):
        resolve_device(name)


def test_torch_runs_on_one_thread_after_loading():
    load_weights("deterministic:base", "carl", device="auto")
    assert torch.get_num_threads() == 1


def test_the_registry_does_not_import_torch():
    code = (
        "import sys, shiftsim.planners.registry as p\n"
        "for e in p.PLANNERS.values(): p.planner_factory(e.name), p.readiness(e)\n"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize("function", ["load_planner", "planner_fingerprint"])
def test_without_torch_a_learned_planner_says_what_to_install(function):
    code = (
        "import sys; sys.modules['torch'] = None\n"
        f"from shiftsim.planners.registry import {function}, readiness, PLANNERS\n"
        "print(readiness(PLANNERS['carl']))\n"
        f"try: {function}('carl', {{'checkpoint': 'deterministic:drive'}})\n"
        "except ImportError as e: print(type(e).__name__, e.message, e.hint, sep='|')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    ready, message = done.stdout.splitlines()
    assert ready == "needs PyTorch: pip install 'shiftsim[learned]'"
    wanted = "MissingExtraError|planner 'carl' needs PyTorch|pip install 'shiftsim[learned]'"
    assert message == wanted
