"""Diffusion Planner's reference folder: all of it agrees, and any changed value is seen."""

import json
import shutil

import numpy as np
import places
import pytest

from shiftsim.verify.files import Scenes
from shiftsim.verify.nets.common import verify_nets, verify_part
from shiftsim.verify.report import Report

pytest.importorskip("torch")
pytestmark = [pytest.mark.learned, pytest.mark.golden, pytest.mark.slow]

from shiftsim.planners.learned.diffusion.planner import INPUTS, DiffusionPlanner  # noqa: E402

GOLDEN = places.GOLDEN / "nets" / "diffusion_planner"
LOOP, FORWARD = "closed_loop_s01_lead_brakes.npz", "forward_empty.npz"
AGENTS, LANES = "overflow_agents_b.npz", "overflow_lanes_b.npz"
# where a change counts: the last sample of a track in sight, a lane that is kept, …
PLACES = {"in.frame": 5, "in.lane": 40, "in.left_boundary": 40, "in.right_boundary": 40}
UNSEEN = {"in.frame00", "in.frame00_type"}  # older than what the network reads


def names_of(file):
    with np.load(GOLDEN / file) as archive:
        return sorted(set(archive.files) - UNSEEN)


@pytest.fixture(scope="module")
def scenes(nuplan_reference):
    return Scenes(nuplan_reference)


@pytest.fixture(scope="module")
def made():
    """Outputs of networks by input."""
    return {}


@pytest.fixture
def quick(monkeypatch, made):
    """Networks run once for the same input."""
    infer = DiffusionPlanner.infer

    def infer_once(planner, features):
        parts = [getattr(features[0], name) for name in (*INPUTS, "noise")]
        key = (id(planner.network), b"".join(part.tobytes() for part in parts))
        if key not in made:
            made[key] = infer(planner, features)
        return made[key]

    monkeypatch.setattr(DiffusionPlanner, "infer", infer_once)


def report_of(folder, scenes):
    report = Report()
    verify_part("diffusion_planner", folder, report, scenes)
    return report


def spoiled(value, index):
    """The array with one value changed."""
    out = value.copy() if value.dtype.kind not in "US" else value.astype(object)
    flat = out.reshape(-1)
    kind = value.dtype.kind
    if kind in "US":
        flat[index] = f"{flat[index]}9"
    elif kind == "b":
        flat[index] = not flat[index]
    else:
        flat[index] += 1 if kind in "iu" else 0.01
    return out.astype(str) if kind in "US" else out


def folder_with(tmp_path, file, name, index):
    with np.load(GOLDEN / file) as archive:
        arrays = {key: archive[key] for key in archive.files}
    arrays[name] = spoiled(arrays[name], index)
    np.savez(tmp_path / file, **arrays)
    return tmp_path


def test_everything_agrees_and_nothing_is_left_out(scenes, nuplan_reference, quick):
    report = Report()
    verify_nets(GOLDEN, report, scenes=nuplan_reference)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.num_cases > 500


@pytest.mark.thorough
@pytest.mark.parametrize("name", names_of(LOOP))
def test_a_changed_value_of_a_closed_loop_is_seen(tmp_path, scenes, quick, name):
    report = report_of(folder_with(tmp_path, LOOP, name, -1), scenes)
    assert report.mismatches or report.not_covered


@pytest.mark.thorough
@pytest.mark.parametrize("name", names_of(FORWARD))
def test_a_changed_value_of_a_forward_pass_is_seen(tmp_path, scenes, quick, name):
    assert report_of(folder_with(tmp_path, FORWARD, name, -1), scenes).mismatches


@pytest.mark.thorough
@pytest.mark.parametrize(("file", "name"), [(f, n) for f in (AGENTS, LANES) for n in names_of(f)])
def test_a_changed_value_of_a_crowded_scene_is_seen(tmp_path, scenes, file, name):
    index = next((i for start, i in PLACES.items() if name.startswith(start)), 0)
    index = 0 if name.endswith(("_type", "_len")) else index
    assert report_of(folder_with(tmp_path, file, name, index), scenes).mismatches


def leaves(value, path=()):
    """Paths of all numbers and texts of a JSON value."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            yield from leaves(inner, (*path, key))
    else:
        yield path


@pytest.mark.thorough
@pytest.mark.parametrize("file", ["args.json", "sampler.json"])
def test_a_changed_value_of_the_settings_is_seen(tmp_path, scenes, file):
    content = json.loads((GOLDEN / file).read_text())
    unseen = []
    for path in list(leaves(content)):
        holder = content
        for key in path[:-1]:
            holder = holder[key]
        kept = holder[path[-1]]
        holder[path[-1]] = f"{kept}9" if isinstance(kept, str) else (kept or 0) + 0.01
        (tmp_path / file).write_text(json.dumps(content))
        unseen += [] if report_of(tmp_path, scenes).mismatches else [path]
        holder[path[-1]] = kept
    assert unseen == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    "change",
    [
        lambda content: content["entries"][5].update(rule="keep"),
        lambda content: content["entries"][5].update(shape=[1]),
        lambda content: content["entries"].pop(),
        lambda content: content.update(parameters=1),
        lambda content: content.update(noise="none"),
        lambda content: content["drive_overrides"].popitem(),
        lambda content: content["checkpoint"].update(prefix="model."),
        lambda content: content["selfcheck"]["first3_raw_z"].reverse(),
    ],
)
def test_a_changed_manifest_is_seen(tmp_path, scenes, change):
    content = json.loads((GOLDEN / "state_dict.json").read_text())
    change(content)
    (tmp_path / "state_dict.json").write_text(json.dumps(content))
    assert report_of(tmp_path, scenes).mismatches


def test_unknown_fields_of_the_sampler_are_named(tmp_path, scenes):
    content = json.loads((GOLDEN / "sampler.json").read_text())
    content["steps"][4]["extra"] = 1
    (tmp_path / "sampler.json").write_text(json.dumps(content))
    report = report_of(tmp_path, scenes)
    assert sum(report.not_covered.values()) == 1
    assert report.mismatches == []


def test_unknown_arrays_and_files_are_named(tmp_path, scenes):
    with np.load(GOLDEN / AGENTS) as archive:
        np.savez(tmp_path / AGENTS, **archive, extra=np.zeros(1))
    shutil.copy(GOLDEN / "args.json", tmp_path / "other.json")
    report = report_of(tmp_path, scenes)
    assert sum(report.not_covered.values()) == 2
    assert report.mismatches == []


@pytest.mark.parametrize(
    "name", ["forward_mixed", "overflow_agents_a", "overflow_lanes_a", "closed_loop_s04_left_turn"]
)
def test_other_cases_agree_too(shared, tmp_path, quick, name):
    folder = shared / "reference" / "nets" / "diffusion_planner"
    shutil.copy(folder / f"{name}.npz", tmp_path)
    report = report_of(tmp_path, Scenes(shared / "reference" / "nuplan"))
    assert report.mismatches == []
    assert report.not_covered == {}
