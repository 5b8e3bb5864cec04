"""Stores and run folders of strangers: nothing is written outside of them, no URL is opened."""

import json
import shutil

import pyarrow.parquet as pq
import pytest
from commands import call
from stores import write_toy_store
from worlds import straight_road

import shiftsim
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.review import Review, Reviews, write_reviews
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import DataError
from shiftsim.files import atomic_write, safe_join
from shiftsim.runs.filter import filter_store
from shiftsim.runs.journal import Journal
from shiftsim.view.build import write_site

SHA = "0" * 64


@pytest.fixture
def home(tmp_path):
    """A folder of the user's, with a file that must stay as it is."""
    folder = tmp_path / "home"
    folder.mkdir()
    (folder / "precious").write_text("mine")
    yield folder
    assert [path.name for path in folder.iterdir()] == ["precious"]
    assert (folder / "precious").read_text() == "mine"


@pytest.fixture
def theirs(clean_run, tmp_path):
    """A run of a stranger."""
    return shutil.copytree(clean_run.path, tmp_path / "theirs")


def changed(path, change):
    values = json.loads(path.read_text("utf-8"))
    change(values)
    path.write_text(json.dumps(values), "utf-8")


@pytest.mark.parametrize("name", ["../home/x", "a/../../home/x", "/etc/passwd", "link/x", "a\0b"])
def test_a_name_that_leads_out_of_its_folder_is_refused(name, tmp_path, home):
    root = tmp_path / "root"
    root.mkdir()
    (root / "link").symlink_to(home)
    with pytest.raises(DataError, match="is outside of this folder"):
        safe_join(root, name)


def test_a_name_inside_a_folder_is_found_also_where_the_folder_is_a_link(tmp_path):
    (tmp_path / "root" / "a").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "root")
    assert safe_join(tmp_path / "link", "a/b") == tmp_path / "link" / "a" / "b"


def test_a_link_at_the_place_of_a_draft_is_not_followed(tmp_path, home):
    (tmp_path / ".page.html.tmp").symlink_to(home / "precious")
    with atomic_write(tmp_path / "page.html") as partial:
        partial.write_text("theirs")
    assert (tmp_path / "page.html").read_text() == "theirs"


def remote(tmp_path, monkeypatch, change):
    monkeypatch.setenv("SHIFTSIM_CACHE", str(tmp_path / "cache"))
    folder = write_toy_store(tmp_path / "bucket" / "toy")
    changed(folder / "store.json", change)
    return folder, f"file://{folder}"


def test_a_remote_store_names_no_file_outside_of_its_copy(tmp_path, monkeypatch, home):
    name = "recordings/log-1/../../../../../../home/x"
    folder, url = remote(tmp_path, monkeypatch, lambda values: values["files"].update({name: SHA}))
    (folder / "recordings/log-1").mkdir(exist_ok=True)
    with pytest.raises(DataError, match="is outside of this folder"):
        open_store(url).read("0001cafe")


@pytest.mark.parametrize("value", ["../../../home", "0" * 63 + "/", "A" * 64, None, 7])
def test_hashes_of_a_store_are_hexadecimal(tmp_path, monkeypatch, home, value):
    folder, url = remote(tmp_path, monkeypatch, lambda values: values.update(hash=value))
    for place in (url, folder):
        with pytest.raises(DataError, match="'hash' has no SHA-256 digest"):
            open_store(place)
    changed(folder / "store.json", lambda v: v.update(hash=SHA, files={"x": value}))
    with pytest.raises(DataError, match="'x' has no SHA-256 digest"):
        open_store(url)
    assert not list((tmp_path / "cache" / "stores").iterdir())


@pytest.mark.thorough
def test_no_command_opens_a_url_that_only_a_run_names(theirs, monkeypatch):
    url = "file:///nowhere/at/all"
    changed(theirs / "manifest.json", lambda values: values.update(store=url))
    asked = call(theirs.parent, "view", "theirs", "--no-open")
    assert asked.returncode == 2
    assert "is behind the URL 'file:///nowhere/at/all'" in asked.stderr
    assert f"if you trust it: --store {url}" in asked.stderr
    typed = call(theirs.parent, "view", "theirs", "--no-open", "--store", url)
    assert "cannot be read" in typed.stderr


def test_a_url_that_the_user_types_is_opened(clean_run, toy, tmp_path, monkeypatch):
    monkeypatch.setenv("SHIFTSIM_CACHE", str(tmp_path / "cache"))
    from shiftsim.runs.scenarios import open_run_store

    assert open_run_store(clean_run, f"file://{toy}").tokens == open_store(toy).tokens


@pytest.mark.parametrize("link", ["view", "view/replay"])
@pytest.mark.thorough
def test_pages_are_not_written_through_a_link(theirs, home, link, toy):
    (theirs / link).parent.mkdir(exist_ok=True)
    (theirs / link).symlink_to(home)
    asked = call(theirs.parent, "view", "theirs", "--no-open", "--limit", "1")
    assert (asked.returncode, "is outside of this folder" in asked.stderr) == (2, True)


@pytest.mark.thorough
def test_a_page_that_is_a_link_is_replaced(theirs, home):
    (theirs / "view").mkdir()
    (theirs / "view" / "index.html").symlink_to(home / "precious")
    asked = call(theirs.parent, "view", "theirs", "--no-open", "--limit", "1")
    assert asked.returncode == 0
    assert not (theirs / "view" / "index.html").is_symlink()


@pytest.mark.parametrize("link", ["unfinished.sqlite", "unfinished.sqlite-wal", "rollouts"])
def test_a_run_is_not_written_through_a_link(theirs, home, link, toy):
    shutil.rmtree(theirs / "rollouts")
    (theirs / link).symlink_to(home / ("precious" if "sqlite" in link else ""))
    changed(theirs / "manifest.json", lambda values: values.update(state="running"))
    with pytest.raises(DataError, match="is outside of this folder"):
        shiftsim.run(
            ["constant-velocity", "log-future"],
            noise=["none", "ou-high"],
            seeds=[0, 1],
            store=str(toy),
            workers=1,
            out=str(theirs),
            retry_failed=True,
        )


@pytest.mark.parametrize("name", ["../../home/precious", "/etc/passwd", "part-0.parquet/.."])
def test_a_table_names_rollouts_of_its_own_run_only(theirs, home, name):
    path = theirs / "tasks.parquet"
    table = pq.read_table(path)
    at = table.schema.get_field_index("rollout")
    pq.write_table(table.set_column(at, "rollout", [[name] * len(table)]), path)
    with pytest.raises(DataError, match="is no file of rollouts"):
        _ = shiftsim.open_run(theirs).rollout_places


WRITERS = {
    "review": lambda store: write_reviews(store, Reviews([Review("0001cafe", "reject")])),
    "filter": lambda store: filter_store(store, workers=1),
    "maps": lambda store: StoreWriter(store).add_map(straight_road()),
}


@pytest.mark.parametrize("link", WRITERS)
def test_a_store_is_not_written_through_a_link(tmp_path, home, link):
    store = write_toy_store(tmp_path / "store")
    shutil.rmtree(store / link, ignore_errors=True)
    (store / link).symlink_to(home)
    with pytest.raises(DataError, match="is outside of this folder"):
        WRITERS[link](store)


def test_a_journal_that_is_a_link_is_neither_emptied_nor_written(tmp_path, home):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "journal").symlink_to(home / "precious")
    with pytest.raises(DataError, match="is outside of this folder"):
        Journal(tmp_path / "run" / "journal", keep=False)


def test_a_site_is_not_written_through_a_link(tmp_path, home):
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "replay").symlink_to(home)
    with pytest.raises(DataError, match="is outside of this folder"):
        write_site(tmp_path / "site", [], title="")
