"""Commands about planners and their weights: planners, checkpoint, train, features, realism."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from shiftsim import cli
from shiftsim.cli import Json, Quiet, echo, new_app, print_result, stdout_to_stderr
from shiftsim.errors import plural
from shiftsim.train.folder import (
    BEST,
    FeatureSettings,
    ImitationSettings,
    Settings,
    TrafficSettings,
)

app = new_app("Planners: what there is, and does mine obey the contract.")
checkpoint = new_app(
    "Checkpoints of learned planners: what is in one; convert it.", no_args_is_help=True
)

Source = Annotated[
    str,
    Argument(metavar="PATH", help="File, folder that holds one, or name in SHIFTSIM_CHECKPOINTS."),
]
train = new_app("Train networks.", no_args_is_help=True)


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
    planner: str = Argument(metavar="PLANNER", help="Name, ./file.py:Class or module:Class."),
    planner_arg: list[str] | None = Option(None, "--planner-arg", help="key=value; repeatable."),
    store: str = Option("demo", help="Store with scenarios to try it on."),
    token: str | None = Option(None, help="Scenario. [the first]"),
    as_json: Json = False,
) -> int:
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
    return cli.USAGE if errors else 0


@checkpoint.command()
def inspect(path: Source, as_json: Json = False) -> None:
    """Which planner a checkpoint is for, whether it loads, its hash, and what was left out."""
    from shiftsim.planners.learned.convert import inspect_checkpoint

    found = inspect_checkpoint(path)
    print_result(asdict(found), found.lines(), as_json=as_json)


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
    print_result(asdict(converted), converted.lines(), as_json=as_json)


def _add_training(planner: str, help: str, of: Any, *named: str) -> None:
    """The command that trains a planner by some settings, of which those `named` are its name."""
    names = [item.name for item in fields(of) if item.name not in named]

    @train.command(planner, help=help)
    @cli.with_settings(*names, of=of)
    def command(
        settings: cli.Settings,
        resume: bool = Option(False, "--resume", help="Go on where it was ended."),
        quiet: Quiet = False,
    ) -> None:
        _require_torch("training")
        from shiftsim.train.recipe import ImitationTraining, Training

        chosen = of(**dict.fromkeys(named, planner), **settings)
        kind = Training if of is Settings else ImitationTraining
        kind(chosen, _on_message(quiet), resume=resume).run()
        echo(f"best network: {chosen.out / BEST}")
        best = f"--checkpoint {planner}={chosen.out / BEST}"
        echo(f"drive with it: shiftsim run -p {planner} {best}")


_IMITATED = {"plantf": "PlanTF", "pluto": "PLUTO", "diffusion-planner": "Diffusion Planner"}
_add_training("carl", "Train CaRL's network to drive as PDM-Closed does.", Settings)
for _planner, _words in _IMITATED.items():
    _add_training(_planner, f"Train {_words} from recordings.", ImitationSettings, "planner")


def _require_torch(what: str) -> None:
    from shiftsim.planners.learned.checkpoint import require_torch

    require_torch(what)


@train.command()
@cli.with_settings(of=TrafficSettings)
def traffic(settings: cli.Settings, quiet: Quiet = False) -> None:
    """Train traffic to move as recorded agents do."""
    _require_torch("training")
    from shiftsim.train.traffic.recipe import train_traffic

    chosen = TrafficSettings(**settings)
    weights = train_traffic(chosen, _on_message(quiet))
    echo(f"weights: {weights}")
    echo(f"how real it is: shiftsim realism {chosen.store} --weights {weights}")


def _on_message(quiet: bool) -> Callable[[str], None]:
    return (lambda text: None) if quiet else partial(echo, err=True)


@cli.with_settings("planner", "out", "split", "seed", "workers", "samples", of=FeatureSettings)
def features(
    settings: cli.Settings,
    store: str = Argument(metavar="STORE", help="Store by name, path or URL."),
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write samples of a store to files, to train on elsewhere."""
    _require_torch("features")
    from shiftsim.train.folder import write_features

    chosen = FeatureSettings(store=store, **settings)
    index = write_features(chosen, _on_message(quiet))
    files = plural(len(index["files"]), "file")
    lines = [f"{index['samples']} samples in {files}: {chosen.out}"]
    lines += [f"not made: {number} {reason}" for reason, number in index["failed"].items()]
    print_result(index, iter(lines), as_json=as_json)


def realism(
    stores: list[str] = Argument(metavar="STORES", help="Stores by name, path or URL."),
    traffic: list[str] | None = Option(
        None, "--traffic", help="Repeatable; by default what there is."
    ),
    weights: Path | None = Option(None, help="Weights of learned traffic, instead of shiftsim's."),
    seconds: float = Option(5.0, min=0.5, help="That agents are driven for."),
    limit: int = Option(0, help="Only so many scenarios of each store."),
    as_json: Json = False,
) -> None:
    """How like the recorded ones agents of each kind of traffic are, some seconds on."""
    from shiftsim.sim.traffic import make_traffic
    from shiftsim.sim.traffic.learned.model import LearnedTraffic
    from shiftsim.train.traffic.realism import compare

    names = traffic or ["learned", "reactive", "constant-velocity"]
    models: dict[str, Any] = {name: partial(make_traffic, name) for name in names}
    for make in models.values():
        make()
    if weights and "learned" in models:
        models["learned"] = partial(LearnedTraffic, weights)
    rows = []
    for store in map(cli.open_store, stores):
        found = compare(map(store.read, store.tokens[: limit or None]), models, seconds)
        rows += [{"store": store.path.name, **row} for row in found]
    print_result(rows, _realism_lines(rows), as_json=as_json)


def _realism_lines(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield (
        f" {'store':16} {'traffic':18} {'distance':>9} {'speed':>10} {'collided':>9} "
        f"{'off road':>9} {'agents':>7}"
    )
    for row in rows:
        yield (
            f" {row['store']:16} {row['traffic']:18} {row['distance_m']:7.2f} m "
            f"{row['speed_mps']:6.2f} m/s {100 * row['collided']:7.2f} % "
            f"{100 * row['off_road']:7.2f} % {row['agents']:7d}"
        )
    span = f"after {rows[0]['seconds']:g} s"
    yield f"distance and speed: of vehicles that move, {span}; others: of all agents"
