"""Commands about planners and their checkpoints: planners, checkpoint."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from shiftsim import cli
from shiftsim.cli import Json, new_app, plural, print_result, stdout_to_stderr

app = new_app("Planners: what there is, and does mine obey the contract.")
checkpoint = new_app(
    "Checkpoints of learned planners: what is in one; convert it.", no_args_is_help=True
)

Source = Annotated[
    str,
    Argument(metavar="PATH", help="File, folder that holds one, or name in SHIFTSIM_CHECKPOINTS."),
]


@app.callback(invoke_without_command=True)
def planners(context: typer.Context, as_json: Json = False) -> None:
    """The planners that come with shiftsim, and whether they are ready to run."""
    if context.invoked_subcommand is None:
        list_planners(as_json)


@app.command("list")
def list_planners(as_json: Json = False) -> None:
    """The planners that come with shiftsim, and whether they are ready to run."""
    from shiftsim.planners.table import PLANNERS, SHIPPED_NOTE, readiness, shipped_file

    missing = {name: readiness(entry) for name, entry in PLANNERS.items()}
    lines = []
    for name, entry in PLANNERS.items():
        lines.append(f" {name:18} {entry.kind:11} {entry.description}")
        more = {}
        if entry.checkpoint is not None:
            more = {"checkpoint": entry.checkpoint.describe(), "its place": entry.checkpoint.place}
            more |= {"without it": SHIPPED_NOTE} if shipped_file(name) is not None else {}
        if entry.arguments:
            more["arguments"] = f"--planner-arg {', '.join(entry.arguments)}"
        if missing[name]:
            more["not ready"] = missing[name]
        lines += [f" {'':18} {title:11} {text}" for title, text in more.items()]
    ready = sum(not text for text in missing.values())
    lines.append(f" {ready} of {len(missing)} are ready to run")
    state = ({"ready": not text, "missing": text} for text in missing.values())
    values = [asdict(e) | more for e, more in zip(PLANNERS.values(), state, strict=True)]
    print_result(values, lines, as_json=as_json)


@app.command("check")
def check_one_planner(
    planner: str = Argument(help="Name, ./file.py:Class or package.module:Class."),
    planner_arg: list[str] | None = Option(None, "--planner-arg", help="key=value; repeatable."),
    store: str = Option("demo", help="Store with scenarios to try it on."),
    token: str | None = Option(None, help="Scenario. [the first]"),
    as_json: Json = False,
) -> None:
    """Does a planner obey the contract? Says what is wrong, and what to do."""
    from shiftsim.planners.contract import HANGS, check_planner
    from shiftsim.planners.registry import load_planner

    arguments = cli.planner_arguments(planner_arg or (), {}, [planner]).get(planner, {})
    scenes = cli.open_store(store)
    scenario = scenes[token or scenes.tokens[0]]
    rows = scenes.summary().select(["city", "token"]).to_pylist()
    others = [row for row in rows if row["token"] != scenario.token]
    # of another map where there is one: a planner that keeps the map of the first shows there
    second = min(others, key=lambda row: row["city"] == scenario.city, default=None)
    with stdout_to_stderr():
        load_planner(planner, arguments)
        make = partial(load_planner, planner, arguments)
        findings = check_planner(make, scenario, second and scenes.read(second["token"]))
    errors = [finding for finding in findings if finding.severity == "error"]
    num_warnings = sum(finding.severity == "warning" for finding in findings)
    verdict = plural(len(errors), "error") if errors else "obeys the contract"
    verdict += f", {plural(num_warnings, 'warning')}" if num_warnings else ""
    lines = [
        *(
            f" {one.severity}: {one.check}: {one.message}" + (one.hint and f"\n   hint: {one.hint}")
            for one in findings
        ),
        f"{planner} on scenario {scenario.token}: {verdict}",
    ]
    print_result([asdict(finding) for finding in findings], lines, as_json=as_json)
    if any(finding.check == HANGS for finding in errors):
        raise KeyboardInterrupt
    if errors:
        raise typer.Exit(cli.USAGE)


@checkpoint.command()
def inspect(path: Source, as_json: Json = False) -> None:
    """Which planner a checkpoint is for, whether it loads, its hash, and what was left out."""
    from shiftsim.planners.learned.convert import inspect_checkpoint

    found = inspect_checkpoint(path)
    print_result(found.to_dict(), found.lines(), as_json=as_json)


@checkpoint.command()
def convert(
    path: Source,
    out: Path = Argument(metavar="OUT", help="File to write: ….safetensors"),
    half: bool = Option(False, "--half", help="As float16, for half the size."),
    as_json: Json = False,
) -> None:
    """Write the weights that the planner loads, and nothing else, to a safetensors file."""
    from shiftsim.planners.learned.convert import convert_checkpoint

    converted = convert_checkpoint(path, out, half=half)
    print_result(converted.to_dict(), converted.lines(), as_json=as_json)
