"""Stores and runs of earlier formats, converted by tools/upgrade.py, give the same numbers."""

import hashlib
import importlib.util
import json
import shutil

import numpy as np
import pytest
from places import GOLDEN, REPOSITORY

from shiftsim.data.store.check import survey_store
from shiftsim.data.store.reading import open_store
from shiftsim.errors import DataError
from shiftsim.runs.results import open_run
from shiftsim.runs.scenarios import open_run_store

pytestmark = pytest.mark.golden
VERSION_1, VERSION_2 = (GOLDEN / f"store_version_{number}" for number in (1, 2))
RUN = GOLDEN / "run_format_4"


@pytest.fixture(scope="module")
def upgrade():
    """The function of the tool."""
    spec = importlib.util.spec_from_file_location("upgrade", REPOSITORY / "tools" / "upgrade.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.upgrade


def digest(array):
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]


@pytest.mark.parametrize("folder", [VERSION_1, VERSION_2])
def test_a_store_has_the_same_numbers(folder, tmp_path, upgrade):
    path = tmp_path / "s"
    shutil.copytree(folder / "store", path)
    (path / "splits").mkdir()
    (path / "splits" / "mine.toml").write_text("tokens = []\n")
    with pytest.raises(DataError, match="version"):
        open_store(path)
    assert "now have format 4" in upgrade(path)
    assert "already" in upgrade(path)
    assert (path / "splits" / "mine.toml").is_file()
    assert not [problem for problem in survey_store(path).problems if problem.kind == ""]
    store, found = open_store(path), {}
    for scene in store:
        parts = {name: getattr(scene, name) for name in ("time_us", "ego")}
        for name in ("valid", "poses", "velocities", "sizes", "kinds"):
            parts[name] = getattr(scene.tracks, name)
        parts["lights"] = scene.traffic_lights.status
        found |= {f"{scene.token} {name}": digest(array) for name, array in parts.items()}
        found[f"{scene.token} tokens"] = list(scene.tracks.tokens)
    road = store.map("fixture-town")
    arrays = {"edges": road.edges.polygons.xy, "cells": road.edges.polygons.cell_items}
    arrays |= {"baselines": road.baselines.xy, "outgoing": road.outgoing.items}
    found |= {name: digest(array) for name, array in arrays.items()}
    found["ids"] = list(road.edges.ids[:3])
    assert found == json.loads((VERSION_1 / "expected.json").read_text("utf-8"))


def test_a_run_with_reactive_tracks_has_the_same_numbers(tmp_path, upgrade):
    path = tmp_path / "run"
    shutil.copytree(RUN / "run", path)
    with pytest.raises(DataError, match="format 4") as error:
        open_run(path)
    assert f"python tools/upgrade.py {path}" in error.value.hint
    assert "4 rollouts now have format 5" in upgrade(path)
    run, found = open_run(path), {}
    store = open_run_store(run)
    for task in run.rollout_places:
        log = run.rollout(task, store.read(task.token))
        parts = {"ego": log.ego, "commands": log.commands, "noise": log.noise}
        for name in ("valid", "poses", "velocities", "sizes"):
            parts[name] = getattr(log.tracks, name)
        found["/".join(map(str, task))] = {name: digest(array) for name, array in parts.items()}
        plan = expected_plans(task)
        assert log.plans[3, :, 0] == pytest.approx(plan, abs=1e-3)
    assert found == {
        name: {key: value for key, value in parts.items() if key != "plan"}
        for name, parts in expected().items()
    }
    for name in ("scores", "metrics"):
        assert (path / f"{name}.parquet").read_bytes() == (
            RUN / "run" / f"{name}.parquet"
        ).read_bytes()


def expected():
    return json.loads((RUN / "expected.json").read_text("utf-8"))


def expected_plans(task):
    return expected()["/".join(map(str, task))]["plan"]


def test_a_run_follows_its_store(tmp_path, upgrade):
    store, path = tmp_path / "store", tmp_path / "run"
    shutil.copytree(RUN / "run" / "store", store)
    shutil.copytree(RUN / "run", path, ignore=shutil.ignore_patterns("store"))
    manifest = json.loads((path / "manifest.json").read_text("utf-8"))
    manifest["determining"]["store"] = json.loads((store / "store.json").read_text())["hash"]
    (path / "manifest.json").write_text(json.dumps({**manifest, "store": str(store)}))
    upgrade(store)
    upgrade(path)
    run = open_run(path)
    assert open_run_store(run).hash == open_store(store).hash
    assert run.rollout(next(iter(run.rollout_places)), open_store(store).read("0000cafe"))


def test_what_is_neither_is_refused(tmp_path, upgrade):
    with pytest.raises(DataError, match="neither a store nor a run folder"):
        upgrade(tmp_path)
