"""What several commands share: options, progress, JSON."""

import json
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


def new_app(help: str = "", **settings: Any) -> typer.Typer:
    """A group of commands."""
    settings = {"add_completion": False, **settings}
    return typer.Typer(
        help=help or None,
        rich_markup_mode=None,  # square brackets in help texts are defaults, not markup
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        **settings,
    )


def say(text: str = "") -> None:
    """One line of output."""
    typer.echo(text)


def say_json(value: Any) -> None:
    """A value as JSON; what JSON does not know becomes text."""
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False, default=str))


def plural(count: int, noun: str) -> str:
    """`1 task`, `2 tasks`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def terminal_width() -> int:
    """Columns of the terminal; 0 where the output goes elsewhere."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else 0


Advance = Callable[[int, int, str], None]


@contextmanager
def progress_bar(*, quiet: bool) -> Iterator[Advance]:
    """Shows how far something is: a bar with the remaining time, or a line per 10 %.

    Yields:
        A function to be called with done, total and a note.
    """
    if quiet:
        yield lambda done, total, note: None
    elif sys.stderr.isatty():
        yield from _bar()
    else:
        yield _lines()


def _bar() -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=None)

        def advance(done: int, total: int, note: str) -> None:
            bar.update(task, completed=done, total=total, description=note)

        yield advance


def _lines() -> Advance:
    began = time.monotonic()
    last = [0]

    def advance(done: int, total: int, note: str) -> None:
        tenth = 10 * done // total if total else 10
        if tenth > last[0]:
            last[0] = tenth
            elapsed = time.monotonic() - began
            left = elapsed / done * (total - done) if done else 0.0
            tail = f"  {note}" if note else ""
            text = f" {10 * tenth:3d} %  {done}/{total}  {elapsed:.0f} s, {left:.0f} s left{tail}"
            typer.echo(text, err=True)

    return advance
