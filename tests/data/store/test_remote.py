"""Stores behind a URL; the local file system stands for any that pyarrow knows."""

import json
import shutil
from time import monotonic

import numpy as np
import pytest
from commands import call
from stores import write_toy_store

import shiftsim
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.review import Review, Reviews, write_reviews
from shiftsim.errors import DataError

TOKEN = "0001cafe"


@pytest.fixture
def remote(tmp_path, monkeypatch):
    """Folder and URL of a store, with an empty cache."""
    monkeypatch.setenv("SHIFTSIM_CACHE", str(tmp_path / "cache"))
    folder = write_toy_store(tmp_path / "bucket" / "toy")
    (folder / "splits").mkdir()
    (folder / "splits" / "small.toml").write_text(f'tokens = ["{TOKEN}"]')
    return folder, f"file://{folder}"


def test_a_store_behind_a_url_holds_the_same_scenarios(remote):
    folder, url = remote
    here, there = open_store(folder), open_store(url)
    assert (there.tokens, there.hash, there.source) == (here.tokens, here.hash, url)
    np.testing.assert_array_equal(there.read(TOKEN).ego, here.read(TOKEN).ego)


def test_only_what_is_needed_is_copied_and_then_kept(remote):
    folder, url = remote
    store = open_store(url)
    assert not (store.path / "recordings").exists()
    store.read(TOKEN)
    assert [path.name for path in (store.path / "recordings").iterdir()] == ["log-1"]
    shutil.rmtree(folder / "recordings")
    open_store(url).read(TOKEN)
    with pytest.raises(DataError, match="cannot be read"):
        open_store(url).read("0002cafe")


def test_a_file_that_was_damaged_on_the_way_is_refused(remote):
    folder, url = remote
    ego = next((folder / "recordings").glob("*1/ego*"))
    ego.write_bytes(ego.read_bytes()[:-1] + b"x")
    with pytest.raises(DataError, match="damaged, or changed"):
        open_store(url).read(TOKEN)


def test_a_damaged_copy_is_made_again_and_that_is_said_once(remote, caplog):
    _, url = remote
    store = open_store(url)
    scene = store.read(TOKEN)
    for copy in (store.path / "recordings").rglob("*.parquet"):
        copy.write_bytes(copy.read_bytes()[: copy.stat().st_size // 2])
    (store.path / "scenarios.parquet").write_bytes(b"")
    again = open_store(url)
    for _ in range(2):
        np.testing.assert_array_equal(again.read(TOKEN).ego, scene.ego)
    assert len({record.getMessage() for record in caplog.records}) == len(caplog.records) > 1
    assert (
        caplog.records[0].getMessage()
        == f"{store.path}/scenarios.parquet is damaged and copied again"
    )


def test_without_a_folder_for_copies_a_store_is_read_all_the_same(remote, tmp_path, caplog):
    folder, url = remote
    (tmp_path / "cache").touch()
    store = open_store(url)
    np.testing.assert_array_equal(store.read(TOKEN).ego, open_store(folder).read(TOKEN).ego)
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == [
        "copies of file"
    ]


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.thorough)])
def test_a_run_on_a_url_gives_the_bytes_of_one_on_the_folder(remote, tmp_path, workers):
    folder, url = remote
    runs = [
        shiftsim.run(
            "constant-velocity",
            store=str(store),
            workers=workers,
            bundle=True,
            out=str(tmp_path / name),
        )
        for store, name in ((folder, "here"), (url, "there"))
    ]
    for name in ("scores.parquet", "metrics.parquet"):
        assert (runs[0].path / name).read_bytes() == (runs[1].path / name).read_bytes()
    assert runs[1].manifest["store"] == url
    assert runs[0].manifest["bundle"] == runs[1].manifest["bundle"]


def test_splits_of_a_store_behind_a_url_are_found_by_name(remote, tmp_path):
    _, url = remote
    out = str(tmp_path / "run")
    run = shiftsim.run("constant-velocity", store=url, split="small", workers=1, out=out)
    assert run.scores["token"].to_pylist() == [TOKEN]


@pytest.mark.parametrize("url", ["nothing://here/store", "file:///no/such/store"])
def test_a_url_that_leads_nowhere_is_named(url, monkeypatch, tmp_path):
    monkeypatch.setenv("SHIFTSIM_CACHE", str(tmp_path))
    with pytest.raises(DataError, match=url):
        open_store(url)


def test_what_the_source_no_longer_has_is_removed_from_the_copy(remote):
    folder, url = remote
    review = write_reviews(folder, Reviews([Review(TOKEN, route=("1",))]))
    (folder / "filter").mkdir()
    (folder / "filter" / "results.parquet").touch()
    copy = open_store(url).path
    assert open_store(url).read(TOKEN).route == ("1",)
    review.unlink()
    shutil.rmtree(folder / "filter")
    (folder / "splits" / "small.toml").unlink()
    assert open_store(url).read(TOKEN).route == open_store(folder).read(TOKEN).route
    assert not open_store(url).is_reviewed
    overlays = [path for name in ("review", "filter", "splits") for path in (copy / name).glob("*")]
    assert overlays == []


def test_stores_that_claim_one_hash_share_no_copy(remote, tmp_path):
    folder, url = remote
    other = shutil.copytree(folder, tmp_path / "elsewhere" / "toy")
    manifest = json.loads((folder / "store.json").read_text())
    changed = shutil.copytree(folder, tmp_path / "changed" / "toy")
    (changed / "store.json").write_text(json.dumps(manifest | {"generator": {"name": "x"}}))
    paths = {open_store(f"file://{place}").path for place in (folder, other, changed)}
    assert len(paths) == 3
    assert open_store(url).path in paths


def test_a_store_behind_a_url_is_not_reviewed_in_its_copy(remote, tmp_path):
    _, url = remote
    asked = call(tmp_path, "inspect", url)
    assert asked.returncode == 1
    assert "is behind a URL" in asked.stderr


@pytest.mark.slow
@pytest.mark.thorough
def test_without_a_network_a_url_of_google_ends_soon_and_in_one_line(tmp_path):
    # where there is a network, there is no such store either
    begin = monotonic()
    asked = call(tmp_path, "check", "gs://shiftsim-no-such-bucket-7f3a/store")
    assert asked.returncode != 0
    assert "Traceback" not in asked.stderr
    assert len(asked.stderr.splitlines()) == 2  # what, and a hint
    assert monotonic() - begin < 15  # imports included
