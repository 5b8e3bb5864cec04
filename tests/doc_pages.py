"""The documentation as a test sees it: blocks to run, links, tables.

A block is run as it stands in the page, in the order of the page, in one folder per page. A comment
on the line before a block changes that:

* `<!-- not run: REASON -->`: its commands are only parsed;
* `<!-- run with: --limit 1 -->`: these words are added to its `shiftsim` commands, to be quick.

A block whose first line names a file (`# run.toml`, or a docstring) is written to that file. A
`text` block shows what the block before it prints; `…` stands for anything.
"""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import typer

from shiftsim.cli import app, main

REPOSITORY = Path(__file__).resolve().parent.parent
PAGES = (REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md")))
_FENCE = re.compile(
    r"^(?:<!-- (?P<marks>.*?) -->\n)?```(?P<kind>\w*)\n(?P<text>.*?)^```$", re.M | re.S
)
_FILE = re.compile(r'^(?:# |""")(?P<name>[\w.-]+\.(?:py|toml|yaml|csv|txt|sh))(?:""")?$')
_SHELL = re.compile(r"[|<>&;$*]")  # what only a shell understands
RUN, SHOWN = ("sh", "python"), ("text",)
PLAIN = ("", "dockerfile", "toml", "yaml", "csv", "json", "bibtex")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    line: int
    kind: str
    text: str
    reason: str  # why it is not run; empty when it is
    words: tuple[str, ...]  # added to its shiftsim commands

    @property
    def where(self) -> str:
        return f"{self.page}:{self.line}"

    @property
    def file(self) -> str:
        """File that the block is written to; empty when it is run."""
        found = _FILE.match(self.text.partition("\n")[0])
        return found["name"] if found else ""

    @property
    def commands(self) -> list[str]:
        """Lines of a shell block, continued ones joined."""
        lines = self.text.replace("\\\n", " ").splitlines()
        return [line for line in lines if shlex.split(line, comments=True)]


def read_blocks(path: Path) -> list[Block]:
    text = path.read_text("utf-8")
    out = []
    for found in _FENCE.finditer(text):
        mark, _, value = (found["marks"] or "").partition(": ")
        assert mark in ("", "not run", "run with"), f"{path.name}: comment {mark!r} unknown"
        line = text[: found.start("kind")].count("\n") + 1
        reason = value if mark == "not run" else ""
        words = tuple(shlex.split(value)) if mark == "run with" else ()
        out.append(Block(path.name, line, found["kind"], found["text"], reason, words))
    assert text.count("\n```") == 2 * len(out), f"{path.name}: a fence is not closed, or indented"
    return out


@dataclass
class Session:
    """What a reader has open who follows one page from its beginning to its end."""

    names: dict[str, Any] = field(default_factory=lambda: {"__name__": "__main__"})
    printed: str = ""

    def do(self, block: Block) -> None:
        """Run a block, or write it to its file; the working directory is that of the page."""
        if block.kind in SHOWN:
            assert_printed(block, self.printed)
        elif block.file:
            Path(block.file).write_text(block.text, "utf-8")
        elif block.kind == "sh":
            self.printed = "\n".join(self._command(block, line) for line in block.commands)
        elif block.kind == "python":
            self.printed = self._python(block)

    def _python(self, block: Block) -> str:
        out = StringIO()
        code = compile("\n" * block.line + block.text, block.where, "exec")
        with redirect_stdout(out):
            exec(code, self.names)
        return out.getvalue()

    def _command(self, block: Block, line: str) -> str:
        words = shlex.split(line, comments=True)
        if words[0] != "shiftsim" or _SHELL.search(line):
            return in_shell(block, line)
        code, printed = call_here([*words[1:], *block.words])
        assert code == 0, f"{block.where}: {line}\n{printed}"
        return printed


def in_shell(block: Block, line: str) -> str:
    search = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    done = subprocess.run(
        ["bash", "-c", line],
        capture_output=True,
        text=True,
        env=os.environ | {"PATH": search},
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, f"{block.where}: {line}\n{done.stdout}{done.stderr}"
    return done.stdout


def call_here(words: list[str]) -> tuple[int, str]:
    """Exit code and output of one `shiftsim` command, in this process: no start, warm kernels."""
    out, before = StringIO(), sys.argv
    sys.argv = ["shiftsim", *words]
    try:
        with redirect_stdout(out), redirect_stderr(out):
            main(words)
    except SystemExit as end:
        return int(end.code or 0), out.getvalue()
    finally:
        sys.argv = before
    raise AssertionError("the command line always exits")


def assert_printed(block: Block, printed: str) -> None:
    """Every line of a `text` block is a line of what was printed."""
    lines = [" ".join(line.split()) for line in printed.splitlines()]
    for wanted in block.text.splitlines():
        parts = " ".join(wanted.split()).split("…")
        pattern = re.compile(".*".join(map(re.escape, parts)))
        found = any(pattern.fullmatch(line) for line in lines)
        assert found, f"{block.where}: not printed: {wanted}\n---\n{printed}"


@cache
def click_commands() -> dict[tuple[str, ...], Any]:
    """The commands of the command line by their words, groups included."""

    def below(command: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
        yield words, command
        for name in command.list_commands(None) if hasattr(command, "list_commands") else ():
            yield from below(command.get_command(None, name), (*words, name))

    return dict(below(typer.main.get_command(app), ()))


def parse_only(words: list[str]) -> tuple[str, ...]:
    """Parse the words of a `shiftsim` command without doing it; which command it is.

    Raises:
        Exception: There is no such command or option, or an argument is missing.
    """
    commands = click_commands()
    path: tuple[str, ...] = ()
    while len(words) > len(path) and (*path, words[len(path)]) in commands:
        path = (*path, words[len(path)])
    rest = words[len(path) :]
    unknown = [word for word in rest[:1] if not word.startswith("-")]
    assert not (hasattr(commands[path], "commands") and unknown), f"no command {words!r}"
    commands[path].make_context(" ".join(path), [word for word in rest if word != "--help"])
    return path


def shiftsim_calls(line: str) -> Iterator[list[str]]:
    """The words of every `shiftsim` command in a line of shell."""
    for part in re.split(r"\|\||&&|[|;&]", line):
        words = shlex.split(part, comments=True)
        if "shiftsim" in words:
            yield [
                re.sub(r"\$\{?\w+\}?", "1", word) for word in words[words.index("shiftsim") + 1 :]
            ]


def anchors(path: Path) -> set[str]:
    """Anchors of the headings of a page, as Markdown makes them."""
    plain = _FENCE.sub("", path.read_text("utf-8"))
    titles = re.findall(r"^#+ (.*)$", plain, flags=re.M)
    slugs = (re.sub(r"[^\w\s-]", "", title.replace("`", "")).strip().lower() for title in titles)
    return {re.sub(r"[-\s]+", "-", slug) for slug in slugs}


def links(path: Path) -> list[str]:
    plain = _FENCE.sub("", path.read_text("utf-8"))
    return re.findall(r"\]\(([^)\s]+)\)", plain)


def table_below(path: Path, heading: str) -> list[list[str]]:
    """Cells of the first table below a heading, backquotes removed, without its head."""
    _, _, rest = path.read_text("utf-8").partition(f"\n{heading}\n")
    assert rest, f"{path.name} has no heading {heading!r}"
    found = re.search(r"^\|.*\n\|[-| :]+\n((?:\|.*\n)+)", rest, flags=re.M)
    assert found, f"{path.name}: no table below {heading!r}"
    rows = found[1].splitlines()
    return [
        [cell.strip().replace("`", "") for cell in row.strip()[1:-1].split("|")] for row in rows
    ]
