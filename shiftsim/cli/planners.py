"""Commands about planners and their checkpoints: planners, checkpoint."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from shiftsim.cli import Json, new_app, plural, say, say_json, show, stdout_to_stderr

_USAGE = 1
app = new_app("Planners: what there is, and does mine obey the contract.")
checkpoint = new_app(
    "Checkpoints of learned planners: what is in one; convert it.", no_args_is_help=True
)

Source = Annotated[
    str,
    typer.Argument(
        metavar="PATH", help="File, folder that holds one, or name in SHIFTSIM_CHECKPOINTS."
    ),
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
    if as_json:
        state = ({"ready": not text, "missing": text} for text in missing.values())
        say_json([asdict(e) | more for e, more in zip(PLANNERS.values(), state, strict=True)])
        return
    for name, entry in PLANNERS.items():
        say(f" {name:18} {entry.kind:11} {entry.description}")
        if entry.checkpoint is not None:
            say(f" {'':18} checkpoint  {entry.checkpoint.describe()}")
            say(f" {'':18} its place   {entry.checkpoint.place}")
            if shipped_file(name) is not None:
                say(f" {'':18} without it  {SHIPPED_NOTE}")
        if entry.arguments:
            say(f" {'':18} arguments   --planner-arg {', '.join(entry.arguments)}")
        if missing[name]:
            say(f" {'':18} not ready   {missing[name]}")
    ready = sum(not text for text in missing.values())
    say(f" {ready} of {len(missing)} are ready to run")


@app.command("check")
def check_one_planner(
    planner: Annotated[
        str,
        typer.Argument(
            help="Name, ./file.py:Class or package.module:Class.",
        ),
    ],
    planner_arg: Annotated[
        list[str] | None, typer.Option("--planner-arg", help="key=value; repeatable.")
    ] = None,
    store: Annotated[
        str,
        typer.Option(help="Store with scenarios to try it on."),
    ] = "demo",
    token: Annotated[str | None, typer.Option(help="Scenario. [the first]")] = None,
    as_json: Json = False,
) -> None:
    """Does a planner obey the contract? Says what is wrong, and what to do."""
    from shiftsim.planners.contract import HANGS, check_planner
    from shiftsim.planners.registry import load_planner
    from shiftsim.runs.config import parse_argument
    from shiftsim.runs.scenarios import open_named_store

    arguments = {}
    for text in planner_arg or ():
        _, name, value = parse_argument(text, (planner,))
        arguments[name] = value
    scenes = open_named_store(store)
    scenario = scenes[token or scenes.tokens[0]]
    rows = scenes.summary().select(["city", "token"]).to_pylist()
    others = [row for row in rows if row["token"] != scenario.token]
    # of another map where there is one: a planner that keeps the map of the first shows there
    others.sort(key=lambda row: row["city"] == scenario.city)
    with stdout_to_stderr():
        load_planner(planner, arguments)
        make = partial(load_planner, planner, arguments)
        findings = check_planner(
            make, scenario, scenes.read(others[0]["token"]) if others else None
        )
    errors = [finding for finding in findings if finding.severity == "error"]
    warnings = [finding for finding in findings if finding.severity == "warning"]
    if as_json:
        say_json([asdict(finding) for finding in findings])
    else:
        for finding in findings:
            say(f" {finding.severity}: {finding.check}: {finding.message}")
            if finding.hint:
                say(f"   hint: {finding.hint}")
        verdict = plural(len(errors), "error") if errors else "obeys the contract"
        verdict += f", {plural(len(warnings), 'warning')}" if warnings else ""
        say(f"{planner} on scenario {scenario.token}: {verdict}")
    if any(finding.check == HANGS for finding in errors):
        raise KeyboardInterrupt
    if errors:
        raise typer.Exit(_USAGE)


@checkpoint.command()
def inspect(path: Source, as_json: Json = False) -> None:
    """Which planner a checkpoint is for, whether it loads, its hash, and what was left out."""
    from shiftsim.planners.learned.convert import inspect_checkpoint

    found = inspect_checkpoint(path)
    show(found.to_dict(), found.lines(), as_json=as_json)


@checkpoint.command()
def convert(
    path: Source,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File to write: ….safetensors")],
    as_json: Json = False,
) -> None:
    """Write the weights that the planner loads, and nothing else, to a safetensors file."""
    from shiftsim.planners.learned.convert import convert_checkpoint

    converted = convert_checkpoint(path, out)
    show(converted.to_dict(), converted.lines(), as_json=as_json)
