"""What people see in a terminal: at once, within 80 columns, in colour if they like, and helped."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time

import pytest

from shiftsim.cli import _COMMANDS, _GROUPS, main
from shiftsim.report.tables import Number, Table, render
from shiftsim.runs.config import RunConfig

COLOUR = re.compile(r"\x1b\[[\d;]*m")


def in_terminal(*words, columns=80, folder=None, **variables):
    """What a command prints into a terminal, and after how many seconds the first of it."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
    began, chunks, first = time.monotonic(), [], None
    settings = {"env": dict(os.environ) | {"TERM": "xterm"} | variables, "cwd": folder}
    ends = dict.fromkeys(("stdin", "stdout", "stderr"), slave)
    command = [sys.executable, "-m", "shiftsim", *map(str, words)]
    with subprocess.Popen(command, **ends, **settings):
        os.close(slave)
        while True:
            try:
                chunk = os.read(master, 65536)
            except OSError:  # all ends of the terminal are closed
                break
            first = first or time.monotonic() - began
            chunks.append(chunk)
    os.close(master)
    return b"".join(chunks).decode().replace("\r\n", "\n"), first


@pytest.fixture
def said(capsys):
    """Exit code, output and errors of a command."""

    def run(*words):
        with pytest.raises(SystemExit) as ended:
            main([*map(str, words)])
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return run


def test_without_a_command_there_is_help_and_no_error(said):
    for words in ((), ("convert",), ("train",)):
        code, out, err = said(*words)
        assert code == 0
        assert out.startswith(f"Usage: {' '.join(('shiftsim', *words))} ")
        assert err == ""


def test_the_help_has_all_commands_by_what_they_are_for(said):
    _, out, _ = said("--help")
    found, heading = {}, ""
    for line in out.splitlines():
        heading = line.rstrip(":") if re.fullmatch(r"[A-Z]\w+:", line) else heading
        if match := re.match(r"  ([a-z]+) ", line):
            found.setdefault(heading, []).append(match[1])
    found.pop("Options", None)
    assert list(found) == list(_GROUPS) == ["Run", "Look", "Data", "Train"]
    assert [name for names in found.values() for name in names] == list(_COMMANDS)
    assert found["Look"] == ["report", "explain", "view", "plot", "diff"]
    assert "..." not in out.split("Run:")[1]  # no sentence is cut
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize(
    ("typed", "meant"), [("rnu", "run"), ("dmeo", "demo"), ("repport", "report")]
)
def test_a_mistyped_command_names_the_one_that_is_meant(said, typed, meant):
    code, _, err = said(typed)
    assert code == 1
    assert f"No such command {typed!r}. Did you mean {meant!r}?" in err


def test_nonsense_is_no_reason_to_suggest_anything(said, clean_run):
    assert "Did you mean" not in said("xqzt")[2]
    hint = said("explain", clean_run.path, "zzzz")[2].splitlines()[1]
    assert hint.startswith("hint: there are ")
    token = clean_run.scores["token"][0].as_py()
    wrong = f"{token[:6]}{'0' if token[6] != '0' else '1'}"
    assert f"did you mean {token!r}?" in said("explain", clean_run.path, wrong)[2]


def test_errors_are_red_where_nobody_objects():
    assert "\x1b[31m" in in_terminal("xqzt")[0]
    assert "\x1b[" not in in_terminal("xqzt", NO_COLOR="1")[0]


def test_the_best_score_of_a_setting_is_marked_and_no_deviation():
    rows = [
        ("a", "none", Number(50.0)),
        ("b", "none", Number(90.0)),
        ("a", "ou-high", Number(70.0)),
        ("", "± 2 seeds", Number(99.0)),
        ("b", "ou-high", Number(60.0)),
    ]
    table = Table("scores", "", ("planner", "noise", "CLS"), rows, 2, best={"CLS": max})
    marked = render(table, "text", mark=lambda text: f"<{text}>")
    assert re.findall(r"<(.*)>", marked) == ["90.00", "70.00"]
    assert "<" not in render(table, "text")


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    folder = tmp_path_factory.mktemp("terminal")
    words = ("run", "-p", "log-future", "-p", "constant-velocity", "--limit", "2", "--workers", "1")
    first = in_terminal(*words, "--out", "one", folder=folder)
    return folder, words, first


@pytest.mark.slow
@pytest.mark.thorough
def test_a_run_says_something_at_once_and_fits_the_terminal(ran):
    folder, words, _ = ran
    text, first = in_terminal(*words, "--out", "two", "--live", folder=folder)
    assert first < 3.0  # a second on an idle machine
    assert "loading NumPy and numba" in text
    assert "0/4" in text  # all tasks, before the first is done
    plain = COLOUR.sub("", text)
    assert re.search(r"^http://127\.0\.0\.1:\d+/\S*$", plain, re.M)
    after = plain[plain.rindex("\n planner ") :]
    assert max(map(len, after.splitlines())) <= 80
    assert "\x1b[32m" in text


@pytest.mark.slow
@pytest.mark.thorough
def test_a_quiet_run_prints_its_results_only(ran):
    folder, words, _ = ran
    done = subprocess.run(
        [sys.executable, "-m", "shiftsim", *words, "--out", "three", "--quiet"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert lines[0].startswith("data        generated")
    assert lines[2].startswith(" planner ")
    assert "settings" not in done.stdout


def test_seeds_that_look_like_a_number_of_seeds_are_explained(said, toy):
    words = ("run", "-p", "idm", "-s", toy, "--noise", "ou-low", "--dry-run", "--seeds")
    assert "3 is the number of a single seed; for 3 seeds: --seeds 0-2" in said(*words, "3")[1]
    for seeds in ("0", "1", "0-2"):
        assert "is the number of a single seed" not in said(*words, seeds)[1]
    help_text = next(x for x in RunConfig.__dataclass_fields__.values() if x.name == "seeds")
    assert "3 is number 3 alone" in help_text.metadata["option"].help
