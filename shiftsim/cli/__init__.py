"""The command line: parse, call the API, print. Nothing heavy is imported before it is needed.

Errors are two lines, the fact and what to do; `--debug` (before or after the command) shows the
traceback. Exit codes: 0 all well, 1 usage or settings, 2 data, 3 finished with failed or missing
tasks, 130 interrupted; `verify` has its own.
"""

import os
import sys
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import typer

from shiftsim.cli.common import new_app
from shiftsim.errors import DataError, ShiftsimError

_USAGE, _DATA, _INTERRUPTED = 1, 2, 130
# of whichever click typer was built on
_ClickError: Any = typer.BadParameter.__mro__[2]
# command -> where it is: a function, or further commands; imported when it is used
_COMMANDS = {
    "demo": "demo:demo",
    "run": "running:run",
    "score": "deriving:score",
    "merge": "deriving:merge",
    "bench": "bench:bench",
    "report": "reading:report",
    "explain": "reading:explain",
    "diff": "reading:diff",
    "check": "stores:check",
    "verify": "doctor:verify",
    "doctor": "doctor:doctor",
    "view": "viewing:view",
    "plot": "viewing:plot",
    "inspect": "viewing:inspect",
    "filter": "stores:filter_scenarios",
    "stats": "stores:show_stats",
    "split": "stores:make_split",
    "planners": "planners:app",
    "convert": "convert:app",
    "export": "stores:export",
    "checkpoint": "planners:checkpoint",
}


class _Commands(typer.core.TyperGroup):
    """The commands of the table above."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Their names, in the order of the help."""
        return list(_COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """One of them, imported; None where there is none."""
        return _command(cmd_name) if cmd_name in _COMMANDS else None


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
    version: bool = typer.Option(False, "--version", help="Print the version and leave."),
) -> None:
    """Closed-loop evaluation of driving planners with nuPlan's semantics."""
    if version:
        from shiftsim import __version__

        typer.echo(__version__)
        raise typer.Exit


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and leave with its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)  # own planners, noises, metrics and traffic beside the user's files
    debug = "--debug" in words
    try:
        code = _run([word for word in words if word != "--debug"], debug)
    except BrokenPipeError:  # the reader of our output has left, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = _USAGE
    sys.exit(code)


def _run(words: list[str], debug: bool) -> int:
    command = typer.main.get_command(app)
    try:
        code = command.main(words, prog_name="shiftsim", standalone_mode=False)
    except (KeyboardInterrupt, typer.Abort):
        return _complain("interrupted", "", _INTERRUPTED)
    except ShiftsimError as error:
        if debug:
            raise
        return _complain(str(error), error.hint, _DATA if isinstance(error, DataError) else _USAGE)
    except OSError as error:
        if debug:
            raise
        where = f"{error.filename}: " if error.filename else ""
        return _complain(f"{where}{error.strerror or error}", "check path and disk", _DATA)
    except _ClickError as error:
        context = getattr(error, "ctx", None)
        path = context.command_path if context is not None else "shiftsim"
        return _complain(error.format_message(), f"{path} --help", _USAGE)
    return code if isinstance(code, int) else 0


def _complain(fact: str, hint: str, code: int) -> int:
    typer.echo(f"error: {fact}", err=True)
    if hint:
        typer.echo(f"hint: {hint}", err=True)
    return code
