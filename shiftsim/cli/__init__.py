"""The command line: parse, call the API, print. Nothing heavy is imported before it is needed.

First what several commands share: options, progress, JSON. Options are made from the settings of a
run or a training: a field of `RunConfig` is an option. Then the table of all commands and the main
function.

Errors are two lines, the fact and what to do; `--debug` (before or after the command) shows the
traceback. Exit codes: 0 all well, 1 usage or settings, 2 data, 3 finished with failed or missing
tasks, 130 interrupted; `verify` has its own.
"""

import inspect
import json
import os
import re
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout
from dataclasses import MISSING, fields
from functools import cache, partial, wraps
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, Any, TextIO, TypeAlias, get_args, get_origin
from urllib.parse import unquote

import typer
from typer import Option

from shiftsim.errors import FAILED, DataError, ShiftsimError, nearest, plural
from shiftsim.runs.config import RunConfig, parse_argument

if TYPE_CHECKING:
    from shiftsim.data.store.reading import ScenarioStore

Json = Annotated[bool, Option("--json", help="Print JSON.")]
Quiet = Annotated[bool, Option("--quiet", "-q", help="Print results only.")]


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


def echo(text: str = "", *, err: bool = False) -> None:
    """Print lines; a terminal gets those that are too long for it broken between words."""
    width = terminal_width(sys.stderr if err else sys.stdout)
    lines = [part for line in text.split("\n") for part in _fitted(line, width)]
    typer.echo("\n".join(lines), err=err)


def _fitted(line: str, width: int) -> list[str]:
    """A line in parts; what follows its first column, or indent, is in one column."""
    if not width or len(re.sub(r"\x1b\[[\d;]*m", "", line)) <= width:
        return [line]
    begin = re.match(r" *(\S+ {2,})?", line)
    indent = " " * (begin.end() if begin else 0)
    whole: Any = {"break_long_words": False, "break_on_hyphens": False, "replace_whitespace": False}
    return wrap(line, width, subsequent_indent=indent or "  ", **whole)


def paint(text: str, colour: str = "green", *, err: bool = False) -> str:
    """A text in a colour, that of the best, on a terminal where NO_COLOR does not forbid it."""
    stream = sys.stderr if err else sys.stdout
    has_colour = stream.isatty() and not os.environ.get("NO_COLOR")
    return typer.style(text, fg=colour, bold=True) if has_colour else text


def print_json(value: Any) -> None:
    """Print a value as JSON; what JSON does not know becomes text."""
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False, default=str))


def print_result(values: Any, lines: Iterable[str], *, as_json: bool) -> None:
    """Print a result as JSON or line by line."""
    if as_json:
        print_json(values)
    else:
        for line in lines:
            echo(line)


def stdout_to_stderr() -> redirect_stdout[TextIO]:
    """What planners print within goes to the standard error, as what workers print does."""
    return redirect_stdout(sys.stderr)


def open_store(path: str | Path) -> "ScenarioStore":
    """The store of a command; the standard error gets a line per report with failed checks."""
    import shiftsim

    store = shiftsim.open_store(path)
    for report, failed in store.failed_checks():
        (what, count), total = next(iter(failed.items())), sum(failed.values())
        first = f"{what.removeprefix(FAILED)} ({count})"
        checks = f"{plural(total, 'failed check')}, the first: {first}"
        echo(f"map {unquote(report.stem)}: {checks}; all in {report}", err=True)
    return store


def terminal_width(stream: TextIO | None = None) -> int:
    """Columns of the terminal; 0 where a stream, the output if none is named, goes elsewhere."""
    is_terminal = (stream or sys.stdout).isatty()
    return shutil.get_terminal_size().columns if is_terminal else 0


def show_in_browser(address: str) -> None:
    """Open an address in the browser, where there is a screen."""
    import webbrowser

    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if screen or sys.platform != "linux":
        webbrowser.open(address)


Advance = Callable[..., None]  # done, total and, where there is one, a note


def progress_bar(*, quiet: bool) -> AbstractContextManager[Advance]:
    """Yields what shows done, total and a note: as a bar with the remaining time, or in lines."""
    return _bar() if sys.stderr.isatty() and not quiet else nullcontext(_lines(quiet))


@contextmanager
def waiting(words: str, *, quiet: bool) -> Iterator[Callable[[str], None]]:
    """Yields what says what is waited for: on a terminal in a line that goes away at the end."""
    if quiet or not sys.stderr.isatty():
        yield partial(_lines(quiet), 0, 0)
        return
    from rich.console import Console

    with Console(stderr=True).status(words) as status:
        yield status.update


@contextmanager
def _bar() -> Iterator[Advance]:
    from rich import progress
    from rich.console import Console

    times = (progress.TimeElapsedColumn(), "ETA", progress.TimeRemainingColumn())
    columns = (progress.BarColumn(), progress.MofNCompleteColumn(), *times, "{task.description}")
    with progress.Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total, note="": bar.update(
            task, completed=done, total=total or None, description=note
        )


def _lines(quiet: bool) -> Advance:
    """A line for each tenth, and one for what happens before."""
    began, last = time.monotonic(), -1

    def advance(done: int, total: int, note: str = "") -> None:
        nonlocal last
        tenth = 10 * done // total if total else 0
        if quiet or tenth <= last or (not tenth and (done or not note)):
            return
        last = tenth
        if not tenth:
            echo(f" {note}", err=True)
            return
        elapsed = time.monotonic() - began
        left = elapsed / done * (total - done)
        tail = f"  {note}" if note else ""
        text = f" {10 * tenth:3d} %  {done}/{total}  {elapsed:.0f} s, {left:.0f} s left{tail}"
        echo(text, err=True)

    return advance


Settings: TypeAlias = dict[str, Any]
_KIND = inspect.Parameter.KEYWORD_ONLY  # those with a default may come first


def with_settings(
    *names: str, of: Any = RunConfig, **helps: str
) -> Callable[[Callable[..., int | None]], Callable[..., int | None]]:
    """Give a command options of settings at its parameter `settings`; `helps` replaces texts."""
    known = {item.name: item for item in fields(of)}
    items = [known[name] for name in names or known]
    in_file = of is RunConfig  # where settings may be that are not given
    options = [_option(item, helps.get(item.name), in_file=in_file) for item in items]

    def decorate(command: Callable[..., int | None]) -> Callable[..., int | None]:
        parameters: list[inspect.Parameter] = []
        for name, parameter in inspect.signature(command).parameters.items():
            parameters += options if name == "settings" else [parameter.replace(kind=_KIND)]

        @wraps(command)
        def call(**values: Any) -> int | None:
            settings = {}
            for item in items:
                value, parse = values.pop(item.name), item.metadata["option"].parse
                if value not in (None, []):
                    text = ",".join(value) if isinstance(value, list) else value
                    settings[item.name] = parse(text) if parse else value
            return command(settings=settings, **values)

        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {p.name: p.annotation for p in parameters}
        return call

    return decorate


def _option(item: Any, text: str | None, *, in_file: bool) -> inspect.Parameter:
    option, kind = item.metadata["option"], item.type
    if get_origin(kind) is dict or (get_origin(kind) is tuple and not option.parse):
        kind = list[get_args(kind)[0]]  # type: ignore[misc]
    elif option.parse:
        kind = list[str] if get_origin(kind) is tuple else str
    flags = option.flags or ((f"--{item.name.replace('_', '-')}",) if kind is bool else ())
    words = Option(*flags, help=text or option.help)
    default = None if in_file else item.default
    default = inspect.Parameter.empty if default is MISSING else default
    kind = Annotated[kind | None, words]
    return inspect.Parameter(item.name, _KIND, default=default, annotation=kind)


def given(**values: Any) -> Settings:
    """The values of the options that were given."""
    return {name: value for name, value in values.items() if value is not None}


def planner_arguments(
    texts: Sequence[str], before: Mapping[str, Any], planners: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Arguments by planner, those of the command line put over what a file says."""
    arguments = {name: dict(table) for name, table in before.items()}
    for text in texts:
        owner, name, value = parse_argument(text, tuple(planners))
        arguments.setdefault(owner, {})[name] = value
    return arguments


# exit codes, which commands return; without one all is well
USAGE, DATA, UNFINISHED, INTERRUPTED = 1, 2, 3, 130
# of whichever click typer was built on
_ClickError: Any = typer.BadParameter.__mro__[2]
# command -> where it is: a function, or further commands; imported when it is used
_COMMANDS = {
    "demo": "run:demo",
    "run": "run:run",
    "bench": "bench:bench",
    "score": "run:score",
    "merge": "run:merge",
    "bundle": "run:bundle",
    "planners": "planners:app",
    "doctor": "doctor:doctor",
    "verify": "doctor:verify",
    "report": "view:report",
    "explain": "view:explain",
    "view": "view:view",
    "plot": "view:plot",
    "diff": "view:diff",
    "data": "bench:data",
    "convert": "convert:app",
    "check": "store:check",
    "stats": "store:show_stats",
    "filter": "store:filter_scenarios",
    "inspect": "view:inspect",
    "split": "store:make_split",
    "edits": "edits:app",
    "mine": "edits:mine",
    "export": "store:export",
    "train": "planners:train",
    "features": "planners:features",
    "checkpoint": "planners:checkpoint",
    "realism": "planners:realism",
}
_GROUPS = {"Run": "demo", "Look": "report", "Data": "data", "Train": "train"}  # by their first


class Interrupted(Exception):
    """The user, or the machine, has stopped a command; the text says how to go on."""


class _Commands(typer.core.TyperGroup):
    """The commands of the table above."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Their names, in the order of the help."""
        return list(_COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """One of them, imported; None where there is none."""
        return _command(cmd_name) if cmd_name in _COMMANDS else None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that is meant, or an error that names the nearest one."""
        if args and args[0] not in _COMMANDS and (near := nearest(args[0], _COMMANDS)):
            ctx.fail(f"No such command {args[0]!r}. Did you mean {near!r}?")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """The commands by what they are for."""
        names = list(_COMMANDS)
        starts = [*map(names.index, _GROUPS.values()), len(names)]
        for group, (first, end) in zip(_GROUPS, pairwise(starts), strict=True):
            words = [(name, _command(name).get_short_help_str(200)) for name in names[first:end]]
            with formatter.section(group):
                formatter.write_dl(words)


@cache
def _command(name: str) -> Any:
    module, _, attribute = _COMMANDS[name].partition(":")
    found = getattr(import_module(f"shiftsim.cli.{module}"), attribute)
    if isinstance(found, typer.Typer):
        command: Any = typer.main.get_group(found)
    else:
        alone = new_app()
        alone.command()(found)
        command = typer.main.get_command(alone)
    command.name = name
    return command


app = new_app(
    "Closed-loop evaluation of driving planners with nuPlan's semantics.",
    name="shiftsim",
    cls=_Commands,
    add_completion=True,
    epilog="Every command explains itself: shiftsim COMMAND --help",
    no_args_is_help=True,
)


@app.callback(invoke_without_command=True)
def _options(
    version: bool = Option(False, "--version", help="Print the version and leave."),
    debug: bool = Option(False, "--debug", help="With any command: show tracebacks."),
) -> None:
    """Closed-loop evaluation of driving planners with nuPlan's semantics."""
    if version:
        from shiftsim._version import __version__

        echo(__version__)
        raise typer.Exit


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and leave with its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    try:
        code = _run([word for word in words if word != "--debug"], debug)
    except BrokenPipeError:  # the reader of our output has left, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = USAGE
    sys.exit(code)


def _run(words: list[str], debug: bool) -> int:
    try:
        command: Any = typer.main.get_command(app)
        code = command.main(words, prog_name="shiftsim", standalone_mode=False)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Interrupted as error:
        return _print_error("interrupted", str(error), INTERRUPTED)
    except (ShiftsimError, OSError) as error:
        if debug:
            raise
        if isinstance(error, ShiftsimError):
            code = DATA if isinstance(error, DataError) else USAGE
            return _print_error(error.message, error.hint, code)
        where = f"{error.filename}: " if error.filename else ""
        return _print_error(f"{where}{error.strerror or error}", "check path and disk", DATA)
    except _ClickError as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            typer.echo(error.format_message())
            return 0
        context = getattr(error, "ctx", None)
        path = context.command_path if context is not None else "shiftsim"
        return _print_error(error.format_message(), f"{path} --help", USAGE)
    if code == INTERRUPTED:  # typer has taken the interrupt for itself
        can_resume = words[:1] == ["train"] and words[1:2] != ["traffic"]
        option = ["--resume"] if can_resume else []
        hint = f"go on, or start again, with: {shlex.join(['shiftsim', *words, *option])}"
        return _print_error("interrupted", hint, INTERRUPTED)
    return code if isinstance(code, int) else 0


def _print_error(fact: str, hint: str, code: int) -> int:
    over = "\r" if code == INTERRUPTED and sys.stderr.isatty() else ""  # the ^C of the terminal
    typer.echo(over, err=True, nl=False)
    echo(f"{paint('error:', 'red', err=True)} {fact}", err=True)
    if hint:
        echo(f"hint: {hint}", err=True)
    return code
