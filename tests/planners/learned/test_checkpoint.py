"""Checkpoints: the published containers load strictly, and nothing in a file is ever run."""

import importlib.util
import json
import pickle
import zipfile
from contextlib import suppress

import numpy as np
import pytest

if importlib.util.find_spec("torch") is None:
    pytest.skip("needs torch", allow_module_level=True)

import torch
from checkpoint_files import (
    LEARNED,
    AttributeDict,
    Callback,
    Hostile,
    diffusion_args,
    lightning_entries,
    save,
    state_of,
    write_diffusion,
    write_published,
)
from hypothesis import given
from hypothesis import strategies as st

from shiftsim.errors import CheckpointError
from shiftsim.planners.learned.checkpoint import (
    empty_state,
    load_weights,
    open_checkpoint,
)
from shiftsim.planners.learned.convert import convert_checkpoint, inspect_checkpoint
from shiftsim.planners.learned.reader import read_contents

pytestmark = [pytest.mark.learned, pytest.mark.usefixtures("checkpoints")]


@pytest.fixture(scope="module")
def plantf():
    return state_of("plantf")


def assert_same(state, expected):
    assert state.keys() == expected.keys()
    for name, value in expected.items():
        assert state[name].dtype == value.dtype, name
        assert torch.equal(state[name], value), name


# --- the published containers


@pytest.mark.parametrize("planner", LEARNED)
def test_a_published_container_loads_with_every_tensor(tmp_path, planner):
    state = state_of(planner)
    path = write_published(tmp_path, planner, state)
    weights = load_weights(str(path), planner)
    assert_same(weights.state, state)


@pytest.mark.parametrize("planner", LEARNED)
def test_the_networks_have_the_official_keys_and_shapes(shared, planner):
    folder = shared / "reference" / "nets" / planner.replace("-", "_")
    described = json.loads((folder / "state_dict.json").read_text())
    rows = described.get("keys") or described["entries"]
    wanted = {row.get("key") or row["name"]: (row["shape"], row["dtype"]) for row in rows}
    state = empty_state(planner)
    made = {n: (list(v.shape), str(v.dtype).removeprefix("torch.")) for n, v in state.items()}
    assert made == wanted


@pytest.mark.parametrize("prefix", ["model.", "model._orig_mod.", ""])
def test_a_lightning_file_may_be_compiled_or_without_prefix(tmp_path, plantf, prefix):
    path = save(lightning_entries(plantf, prefix), tmp_path / "a.ckpt")
    assert_same(load_weights(str(path), "plantf").state, plantf)


@pytest.mark.parametrize("prefix", ["module.", "", "module._orig_mod."])
def test_the_averaged_weights_of_diffusion_planner_are_used(tmp_path, prefix):
    state = state_of("diffusion-planner")
    path = write_diffusion(tmp_path, state, prefix)
    weights = load_weights(str(path), "diffusion-planner")
    assert_same(weights.state, state)
    assert weights.args["hidden_dim"] == 192


def test_a_bare_state_of_parameters_loads(tmp_path):
    state = state_of("carl")
    entries = {f"_orig_mod.{n}": torch.nn.Parameter(v) for n, v in state.items()}
    path = save(entries, tmp_path / "model_best.pth")
    weights = load_weights(str(path), "carl")
    assert_same(weights.state, state)
    assert not any(value.requires_grad for value in weights.state.values())


def test_half_precision_becomes_the_networks_own(tmp_path, plantf):
    half = {n: v.half() if v.is_floating_point() else v for n, v in plantf.items()}
    weights = load_weights(str(save(lightning_entries(half), tmp_path / "a.ckpt")), "plantf")
    assert weights.state["norm.bias"].dtype == torch.float32


def test_the_old_format_of_torch_loads(tmp_path, plantf):
    path = tmp_path / "old.ckpt"
    save(lightning_entries(plantf), path, _use_new_zipfile_serialization=False)
    assert_same(load_weights(str(path), "plantf").state, plantf)


# --- what else is in a file


def test_objects_of_foreign_classes_are_left_out_and_named(tmp_path, plantf):
    entries = lightning_entries(plantf)
    entries["hyper_parameters"] = AttributeDict(lr=0.1, nested=AttributeDict(a=np.float64(1.0)))
    entries["callbacks"] = {"best": Callback(), Callback: [Callback()]}
    path = save(entries, tmp_path / "a.ckpt")
    assert_same(load_weights(str(path), "plantf").state, plantf)
    skipped = open_checkpoint(path).skipped
    assert {"checkpoint_files.AttributeDict", "checkpoint_files.Callback"} <= set(skipped)


@pytest.mark.parametrize("old", [False, True])
def test_a_hostile_object_is_never_run(tmp_path, plantf, old):
    marker = tmp_path / "marker"
    entries = lightning_entries(plantf)
    entries["callbacks"] = [Hostile(marker)]
    path = tmp_path / "a.ckpt"
    save(entries, path, _use_new_zipfile_serialization=not old)
    with pytest.raises(CheckpointError, match="more than tensors") as caught:
        load_weights(str(path), "plantf")
    assert "where you trust it" in caught.value.hint
    assert not marker.exists()


def test_the_test_of_hostility_would_notice(tmp_path):
    marker = tmp_path / "marker"
    pickle.loads(pickle.dumps(Hostile(marker)))
    assert marker.exists()


def test_a_foreign_object_in_the_place_of_a_tensor_is_a_missing_tensor(tmp_path, plantf):
    entries = lightning_entries(plantf)
    entries["state_dict"]["model.norm.bias"] = Callback()
    path = save(entries, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match=r"1 missing: norm\.bias"):
        load_weights(str(path), "plantf")


def test_a_plain_pickle_is_refused_unread(tmp_path):
    marker, path = tmp_path / "marker", tmp_path / "a.ckpt"
    path.write_bytes(pickle.dumps(Hostile(marker)))
    with pytest.raises(CheckpointError, match="neither a torch nor a safetensors file"):
        read_contents(path)
    assert not marker.exists()


def test_foreign_objects_beside_tensors_change_no_views_or_types(tmp_path):
    base = torch.arange(24.0).reshape(4, 6)
    tensors = {
        "transposed": base.T,
        "row": base[2],
        "strided": base[1::2, ::3],
        "scalar": torch.tensor(3),
        "empty": torch.zeros(0, 3),
        **{
            f"type_{i}": torch.ones(2, dtype=t)
            for i, t in enumerate((torch.float64, torch.bfloat16, torch.bool, torch.int8))
        },
    }
    plain = read_contents(save(tensors, tmp_path / "plain.pth"))
    mixed = read_contents(save({**tensors, "extra": Callback()}, tmp_path / "mixed.pth"))
    assert plain.skipped == () != mixed.skipped
    for name, value in tensors.items():
        for found in (plain.entries[name], mixed.entries[name]):
            assert found.dtype == value.dtype
            assert torch.equal(found, value)


# --- wrong and damaged files


@pytest.mark.parametrize("planner", LEARNED)
@pytest.mark.parametrize("wanted", LEARNED)
@pytest.mark.thorough
def test_a_file_of_another_planner_says_whose_it_is(tmp_path, planner, wanted):
    if planner == wanted:
        return
    path = write_published(tmp_path, planner, state_of(planner))
    with pytest.raises(CheckpointError, match=f"not for planner '{wanted}': it looks like") as e:
        load_weights(str(path), wanted)
    assert f"'{planner}'" in str(e.value)
    assert f"--planner {planner}" in e.value.hint


def test_a_file_of_no_planner_says_so(tmp_path):
    path = save({"layer.weight": torch.ones(3)}, tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match="nor for any other known here"):
        load_weights(str(path), "carl")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("model.norm.bias"), r"tensors 1 missing: norm\.bias"),
        (lambda s: s.update({"model.extra": torch.ones(1)}), "1 unexpected: extra"),
        (lambda s: s.update({"loss.weight": torch.ones(1)}), r"1 unexpected: loss\.weight"),
        (
            lambda s: s.update({"model.norm.bias": torch.ones(64)}),
            r"1 of another shape: norm\.bias is 64, not 128",
        ),
        (
            lambda s: [s.pop(n) for n in list(s)[:5]],
            r"5 missing: pos_emb\.0\.weight, pos_emb\.0\.bias, pos_emb\.2\.weight and 2 more",
        ),
        (
            lambda s: s["model.norm.bias"].fill_(np.nan),
            r"norm\.bias has values that are not finite",
        ),
    ],
)
@pytest.mark.thorough
def test_a_state_that_does_not_fit_names_the_tensors(tmp_path, change, message):
    entries = lightning_entries(state_of("plantf"))
    change(entries["state_dict"])
    path = save(entries, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match=message):
        load_weights(str(path), "plantf")


def write_zip(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "text")


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda p: p.write_bytes(b""), "is empty"),
        (
            lambda p: p.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n"),
            "Git LFS pointer",
        ),
        (lambda p: p.write_text("\n<!DOCTYPE html><html>"), "web page: the download has failed"),
        (lambda p: p.write_text("hello"), "neither a torch nor a safetensors file"),
        (write_zip, "is damaged, or holds more"),
        (lambda p: save([1, 2], p), "holds one list, not tensors by name"),
        (lambda p: save({"state_dict": {}, "epoch": 1}, p), "holds no tensors"),
        (lambda p: torch.jit.script(torch.nn.Linear(2, 2)).save(p), "torchscript"),
        (lambda p: p.mkdir(), "holds no checkpoints"),
        (lambda p: p.write_bytes(b"\x10" + bytes(7) + b'{"a": 1}      '), "is damaged"),
    ],
)
def test_what_is_no_checkpoint_says_what_it_is(tmp_path, write, message):
    path = tmp_path / "a.pth"
    write(path)
    with pytest.raises(CheckpointError, match=message):
        load_weights(str(path), "carl")


@pytest.fixture(scope="module")
def small_files(tmp_path_factory):
    """One small file of every kind."""
    folder = tmp_path_factory.mktemp("small")
    tensors = {"a.weight": torch.ones(4, 5), "a.bias": torch.arange(5)}
    old = {"_use_new_zipfile_serialization": False}
    return [
        save(tensors, folder / "zip.pth").read_bytes(),
        save({**tensors, "x": Callback()}, folder / "foreign.pth").read_bytes(),
        save(tensors, folder / "old.pth", **old).read_bytes(),
    ]


@given(kind=st.integers(0, 2), share=st.floats(0.0, 1.0), value=st.integers(-1, 255))
def test_a_damaged_file_is_one_clear_error_or_still_whole(
    small_files, tmp_path_factory, kind, share, value
):
    """Cut at a random place (value -1), or one byte changed."""
    data = bytearray(small_files[kind])
    place = int(share * (len(data) - 1))
    data[place:] = [] if value < 0 else [value, *data[place + 1 :]]
    path = tmp_path_factory.mktemp("damaged") / "a.pth"
    path.write_bytes(bytes(data))
    with suppress(CheckpointError):
        read_contents(path)
        assert value >= 0, "a part is missing"


def test_a_truncated_file_is_called_damaged(tmp_path, plantf):
    path = save(lightning_entries(plantf), tmp_path / "a.ckpt")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(CheckpointError, match="is damaged") as caught:
        load_weights(str(path), "plantf")
    assert "download it again" in caught.value.hint


def test_diffusion_planner_wants_its_args(tmp_path):
    path = write_diffusion(tmp_path, state_of("diffusion-planner"))
    for wrong in ({"hidden_dim": "wide"}, {**diffusion_args(), "state_normalizer": None}):
        (tmp_path / "args.json").write_text(json.dumps(wrong))
        with pytest.raises(CheckpointError, match=r"args of diffusion-planner|from its args"):
            load_weights(str(path), "diffusion-planner")
    (tmp_path / "args.json").write_text("[1]")
    with pytest.raises(CheckpointError, match="holds list, not an object"):
        load_weights(str(path), "diffusion-planner")
    (tmp_path / "args.json").unlink()
    with pytest.raises(CheckpointError, match=r"has no args\.json beside it"):
        load_weights(str(path), "diffusion-planner")


# --- safetensors


@pytest.mark.thorough
@pytest.mark.parametrize("planner", LEARNED)
def test_a_converted_file_loads_with_equal_tensors(tmp_path, planner):
    state = state_of(planner)
    source = write_published(tmp_path / "source", planner, state)
    out = tmp_path / "made.safetensors"
    made = convert_checkpoint(str(source), out)
    assert (made.planner, made.problem) == (planner, "")
    assert made.made_from == inspect_checkpoint(str(source)).sha256
    weights = load_weights(str(out), planner)
    assert_same(weights.state, state)
    assert weights.args == load_weights(str(source), planner).args


def test_a_file_of_half_size_holds_the_nearest_numbers(tmp_path, plantf):
    source = save(lightning_entries(plantf), tmp_path / "a.ckpt")
    out, half = tmp_path / "a.safetensors", tmp_path / "half.safetensors"
    convert_checkpoint(str(source), out)
    assert convert_checkpoint(str(source), half, half=True).problem == ""
    assert half.stat().st_size < 0.52 * out.stat().st_size
    exact, near = (load_weights(str(path), "plantf").state for path in (out, half))
    for name, value in exact.items():
        assert near[name].dtype == value.dtype
        wanted = value.half().to(value.dtype) if value.is_floating_point() else value
        assert near[name].equal(wanted)


def test_what_is_not_complete_is_not_converted(tmp_path, plantf):
    entries = lightning_entries(plantf)
    del entries["state_dict"]["model.norm.bias"]
    source = save(entries, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="1 missing"):
        convert_checkpoint(str(source), tmp_path / "b.safetensors")
    assert not (tmp_path / "b.safetensors").exists()
    assert "1 missing" in inspect_checkpoint(str(source)).problem
