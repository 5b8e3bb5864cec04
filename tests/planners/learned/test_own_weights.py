"""Which weights drive where several could, and that it is said wherever their scores are."""

import importlib.util

import pytest

if importlib.util.find_spec("torch") is None:
    pytest.skip("needs torch", allow_module_level=True)

from checkpoint_files import LEARNED, save, state_of
from stores import write_toy_store
from typer.testing import CliRunner

import shiftsim
from shiftsim.benchmarks import published as published_figures
from shiftsim.cli import app
from shiftsim.errors import CheckpointError, ConfigError
from shiftsim.planners.learned.checkpoint import checkpoint_fingerprint, file_hash, find_checkpoint
from shiftsim.planners.registry import PLANNERS, load_planner, planner_fingerprint, readiness
from shiftsim.planners.table import PUBLISHED, SHIPPED_NOTE
from shiftsim.report.build import Options, make_tables
from shiftsim.report.groups import read_groups

pytestmark = [pytest.mark.learned, pytest.mark.usefixtures("checkpoints")]

SAID = f"carl, {SHIPPED_NOTE}"


@pytest.fixture
def official(checkpoints):
    """The official file of CaRL, in its place."""
    folder = checkpoints / "nuplan_51892_1B"
    folder.mkdir()
    state = {name: 2.0 * value for name, value in state_of("carl").items()}
    return save(state, folder / "model_best.pth")


@pytest.fixture
def toy_run(tmp_path, monkeypatch):
    """Makes runs of a tiny store."""
    monkeypatch.chdir(tmp_path)
    write_toy_store(tmp_path / "toy", count=2, iterations=6)

    def run(*planners, **settings):
        settings = {"store": "./toy", "workers": 1, **settings}
        return shiftsim.run(list(planners), **settings)

    return run


def cli(*words):
    """The output of a command in this process."""
    done = CliRunner().invoke(app, words)
    return done.output if done.exception is None else repr(done.exception)


# --- the order


def test_the_official_file_goes_before_our_own_weights(own_weights, checkpoints):
    assert find_checkpoint("", "carl") == own_weights
    assert readiness(PLANNERS["carl"]) == ""
    folder = checkpoints / "nuplan_51892_1B"
    folder.mkdir()
    theirs = save(state_of("carl"), folder / "model_best.pth")
    assert find_checkpoint("", "carl") == theirs
    assert find_checkpoint("official", "carl") == theirs
    assert find_checkpoint("shiftsim", "carl") == own_weights


def test_what_is_given_goes_before_both(own_weights, official, tmp_path):
    mine = save(state_of("carl"), tmp_path / "mine.pth")
    assert find_checkpoint(str(mine), "carl") == mine
    assert load_planner("carl", {"checkpoint": str(mine)}).name == "carl"


def test_a_folder_called_like_a_word_is_not_meant(own_weights, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shiftsim").mkdir()
    assert find_checkpoint("shiftsim", "carl") == own_weights
    assert checkpoint_fingerprint("shiftsim", "carl") == file_hash(own_weights)


@pytest.mark.usefixtures("no_weights_of_our_own")
def test_a_checkout_without_our_weights_has_none():
    with pytest.raises(CheckpointError, match="planner 'carl' needs a checkpoint"):
        load_planner("carl")
    with pytest.raises(CheckpointError, match="no weights of shiftsim's own for planner 'carl'"):
        load_planner("carl", {"checkpoint": "shiftsim"})


# --- where the official one is


@pytest.mark.parametrize("planner", LEARNED)
def test_what_is_official_is_named_with_its_size_and_place(planner, checkpoints, own_weights):
    with pytest.raises(CheckpointError, match=f"official checkpoint of planner '{planner}'") as hit:
        load_planner(planner, {"checkpoint": "official"})
    published, listed = PUBLISHED[planner], cli("planners", "list")
    for part in (
        published.file,
        published.project,
        f"{published.megabytes} MB",
        str(checkpoints / published.name),
    ):
        assert part in hit.value.hint
        assert part in listed
    assert ("--checkpoint carl=shiftsim" in hit.value.hint) == (planner == "carl")


def test_the_weights_are_as_large_as_is_said():
    for planner, published in PUBLISHED.items():
        size = sum(value.nbytes for value in state_of(planner).values()) / 1e6
        assert round(size) == published.megabytes


def test_a_hash_is_told_where_it_is_known():
    from dataclasses import replace

    assert "SHA-256 ab12" in replace(PUBLISHED["carl"], sha256="ab12").describe()


# --- what is said


def test_our_weights_are_known_by_their_content(own_weights, official, tmp_path):
    copied = tmp_path / "copied.safetensors"
    copied.write_bytes(own_weights.read_bytes())
    for checkpoint in (str(copied), "shiftsim", f"shiftsim,{official}"):
        assert planner_fingerprint("carl", {"checkpoint": checkpoint})["weights"] == SHIPPED_NOTE
    assert "weights" not in planner_fingerprint("carl")


def test_header_manifest_and_tables_say_whose_weights_drove(own_weights, toy_run):
    run = toy_run("carl", "constant-velocity")
    identities = run.manifest["determining"]["planners"]
    assert identities["carl"]["weights"] == SHIPPED_NOTE
    assert "weights" not in identities["constant-velocity"]
    assert SAID in run.table()
    notes = {table.name: " ".join(table.notes) for table in make_tables(read_groups([run]))}
    assert SAID in notes["scores"]
    assert SAID in notes["planning-time"]
    assert SAID not in notes["data-statistics"]
    header = cli("run", "--planner", "carl", "--store", "./toy", "--dry-run")
    assert f"weights     {SAID}; SHA-256 {file_hash(own_weights)[:12]}\n" in header
    assert SHIPPED_NOTE in cli("planners", "list")


def test_other_weights_are_named_in_the_header_too(official, toy_run):
    toy_run("constant-velocity")
    words = ("run", "--planner", "carl", "--store", "./toy", "--dry-run")
    assert f"weights     carl, SHA-256 {file_hash(official)[:12]}\n" in cli(*words)
    made_up = cli(*words, "--checkpoint", "deterministic:drive")
    assert "weights     carl, deterministic:drive: made up, the scores mean nothing\n" in made_up


# --- beside the published figures


def tables_beside(*runs):
    return make_tables(read_groups(runs), published_figures(), Options(with_published=True))


def planners_of(tables):
    return {str(row[0]) for table in tables if table.name == "scores" for row in table.rows}


def test_nothing_stands_in_for_the_papers_planner_unasked(own_weights, toy_run):
    unasked = toy_run("carl", "constant-velocity", out="a")
    tables = tables_beside(unasked)
    assert planners_of(tables) == {"constant-velocity"}
    assert any(f"left out: {SAID}" in note for table in tables for note in table.notes)
    assert planners_of(make_tables(read_groups([unasked]))) == {"carl", "constant-velocity"}

    asked = toy_run("carl", "constant-velocity", checkpoints=["carl=shiftsim"], out="b")
    tables = tables_beside(asked)
    assert planners_of(tables) == {"carl", "constant-velocity"}
    assert any(SAID in note for table in tables for note in table.notes)
    with pytest.raises(ConfigError, match="nothing to show beside published figures"):
        tables_beside(toy_run("carl", out="c"))


def test_a_track_beside_the_papers_figures_wants_the_official_file(own_weights, toy_run):
    toy_run("constant-velocity")
    words = ("bench", "state-drift", "-p", "carl", "-s", "./toy", "--dry-run")
    assert "everything checked" in cli(*words)
    assert "official checkpoint of planner 'carl'" in cli(*words, "--published")
    for asked in ("carl=shiftsim", "shiftsim"):
        assert "everything checked" in cli(*words, "--published", "--checkpoint", asked)
