"""The command line: parse, call the API, print. Nothing heavy is imported before it is needed.

Errors are two lines, the fact and what to do; `--debug` (before or after the command) shows the
traceback. Exit codes: 0 all well, 1 usage or settings, 2 data, 3 finished with failed or missing
tasks, 130 interrupted; `verify` has its own.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from shiftsim.cli import bench, checkpoint, convert, reading, running, stores, viewing
from shiftsim.errors import DataError, ShiftsimError

_USAGE, _DATA, _INTERRUPTED = 1, 2, 130
# of whichever click typer was built on
_ClickError: Any = typer.BadParameter.__mro__[2]

app = typer.Typer(
    name="shiftsim",
    help="Closed-loop evaluation of driving planners with nuPlan's semantics.",
    epilog="Every command explains itself: shiftsim COMMAND --help",
    no_args_is_help=True,
    rich_markup_mode=None,  # square brackets in help texts are defaults, not markup
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def _options(
    version: bool = typer.Option(False, "--version", help="Print the version and leave."),
) -> None:
    """Closed-loop evaluation of driving planners with nuPlan's semantics."""
    if version:
        from shiftsim._version import __version__

        typer.echo(__version__)
        raise typer.Exit


running.register(app)
bench.register(app)
reading.register(app)
viewing.register(app)
convert.register(app)
stores.register(app)
checkpoint.register(app)


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
