"""Ctrl-C ends every long command in one line that says how to go on."""

import pytest

import shiftsim.runs.execute  # noqa: F401  what is imported while a test replaces it would stay
from shiftsim.cli import main

CASES = [
    (
        "filter {store}",
        "shiftsim.runs.filter.filter_store",
        "start again, with: shiftsim filter",
    ),
    (
        "convert dsc3d x --store y",
        "shiftsim.data.readers.dsc3d.open_site",
        "start again, with: shiftsim convert dsc3d x --store y",
    ),
    (
        "convert av2 x --store y",
        "shiftsim.data.readers.convert.convert",
        "start again, with: shiftsim convert av2 x --store y",
    ),
    (
        "convert nuplan x y --store z",
        "shiftsim.data.nuplan.convert.convert_nuplan",
        "start again, with: shiftsim convert nuplan x y --store z",
    ),
    ("stats {store}", "shiftsim.data.store.statistics.store_stats", "start again, with: shiftsim"),
    (
        "demo --out x",
        "shiftsim.data.synthetic.store.demo_store",
        "start again, with: shiftsim demo",
    ),
    (
        "run -p idm --store {store}",
        "shiftsim.runs.prepare.prepare",
        "start again, with: shiftsim run",
    ),
    (
        "run -p idm --store {store} --out x",
        "shiftsim.runs.execute.execute",
        "kept: x; go on with: shiftsim run -p idm --store {store} --out x --resume",
    ),
]


def leave(words, capsys, monkeypatch):
    """Exit code and errors of a command."""
    monkeypatch.setattr("sys.argv", ["shiftsim", *words])
    with pytest.raises(SystemExit) as left:
        main()
    return left.value.code, capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(("words", "work", "hint"), CASES, ids=[case[0] for case in CASES])
def test_an_interrupt_ends_in_one_line(words, work, hint, toy, tmp_path, capsys, monkeypatch):
    def stop(*given, **settings):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(work, stop)

    code, lines = leave(words.format(store=toy).split(), capsys, monkeypatch)

    assert code == 130
    assert lines[-2] == "error: interrupted"
    assert hint.format(store=toy) in lines[-1]


def test_a_training_goes_on_with_resume(toy, tmp_path, capsys, monkeypatch):
    pytest.importorskip("torch")

    def stop(training):
        raise KeyboardInterrupt

    monkeypatch.setattr("shiftsim.train.recipe.Training.run", stop)
    words = ["train", "carl", "--out", str(tmp_path / "out"), "--store", str(toy)]

    code, lines = leave(words, capsys, monkeypatch)

    assert code == 130
    assert lines[-1].endswith(f"--store {toy} --resume")
