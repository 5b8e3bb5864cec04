"""`shiftsim train`: making weights."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from shiftsim.cli import Json, Quiet, new_app, say, show

app = new_app("Train networks.")


@app.command()
def carl(
    out: Annotated[Path, typer.Option(help="Folder for networks, curves and what was collected.")],
    store: Annotated[str, typer.Option(help="Store by name, path or URL.")] = "demo",
    split: Annotated[
        str,
        typer.Option(
            help="Split of the store; all its scenarios if empty.",
        ),
    ] = "",
    checkpoint: Annotated[
        str, typer.Option(help="Weights to begin with: a file, or shiftsim. Else from nothing.")
    ] = "",
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:N or auto.")] = "cpu",
    seed: Annotated[int, typer.Option(help="Of everything that is random.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes that drive, threads that train.")] = 2,
    rounds: Annotated[int, typer.Option(help="Of collecting, training and testing.")] = 8,
    states: Annotated[int, typer.Option(help="Labelled states to collect in all.")] = 360_000,
    samples: Annotated[
        int, typer.Option(help="States to train on, each time counted.")
    ] = 1_280_000,
    tau: Annotated[float, typer.Option(help="Of the labels [s]; 0 to choose it.")] = 0.0,
    tests: Annotated[int, typer.Option(help="Scenarios that each round is tested on.")] = 40,
    ppo_samples: Annotated[int, typer.Option(help="Steps of PPO afterwards.")] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where it was ended.")] = False,
    quiet: Quiet = False,
) -> None:
    """Train CaRL's network to drive as PDM-Closed does."""
    from shiftsim.planners.learned.device import require_torch

    require_torch("training")
    from shiftsim.train.folder import Settings
    from shiftsim.train.recipe import Training

    settings = Settings(
        store=store,
        out=out,
        split=split,
        checkpoint=checkpoint,
        seed=seed,
        rounds=rounds,
        states=states,
        samples=samples,
        tau=tau,
        tests=tests,
        ppo_samples=ppo_samples,
        device=device,
        workers=workers,
    )
    Training(settings, _on_message(quiet), resume=resume).run()
    say(f"best network: {settings.best}")
    say(f"drive with it: shiftsim run -p carl --checkpoint carl={settings.best}")


@app.command()
def traffic(
    out: Annotated[Path, typer.Option(help="Folder for weights, losses and how real they are.")],
    store: Annotated[str, typer.Option(help="Store by name, path or URL.")] = "demo",
    split: Annotated[
        str, typer.Option(help="Split of the store; all its scenarios if empty.")
    ] = "",
    seed: Annotated[int, typer.Option(help="Of everything that is random.")] = 0,
    rounds: Annotated[int, typer.Option(help="Of collecting and training.")] = 5,
    scenarios: Annotated[int, typer.Option(help="That each round collects from.")] = 150,
    epochs: Annotated[int, typer.Option(help="Of each round.")] = 8,
    tests: Annotated[int, typer.Option(help="Scenarios that the result is measured on.")] = 100,
    quiet: Quiet = False,
) -> None:
    """Train traffic to move as recorded agents do."""
    from shiftsim.planners.learned.device import require_torch

    require_torch("training")
    from shiftsim.train.traffic.recipe import TrafficSettings, train_traffic

    settings = TrafficSettings(store, out, split, seed, rounds, scenarios, epochs, tests)
    say(f"weights: {train_traffic(settings, _on_message(quiet))}")
    say(f"how real it is: shiftsim realism {store} --weights {out}/weights.npz")


def _on_message(quiet: bool) -> Callable[[str], None]:
    return (lambda text: None) if quiet else partial(typer.echo, err=True)


def realism(
    stores: Annotated[list[str], typer.Argument(help="Stores by name, path or URL.")],
    traffic: Annotated[
        list[str] | None, typer.Option("--traffic", help="Repeatable; by default what there is.")
    ] = None,
    weights: Annotated[
        Path | None, typer.Option(help="Weights of learned traffic, instead of shiftsim's.")
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="That agents are driven for.")] = 5.0,
    limit: Annotated[int, typer.Option(help="Only so many scenarios of each store.")] = 0,
    as_json: Json = False,
) -> None:
    """How like the recorded ones agents of each kind of traffic are, some seconds on."""
    from shiftsim.runs.scenarios import open_named_store
    from shiftsim.sim.traffic import make_traffic
    from shiftsim.train.traffic.realism import compare

    names = traffic or ["learned", "reactive", "constant-velocity"]
    models = {name: partial(_traffic, name, weights) for name in names}
    for name in names:
        make_traffic(name)
    rows = []
    for store in stores:
        found = open_named_store(store)
        tokens = found.tokens[: limit or None]
        named = compare(map(found.read, tokens), models, seconds)
        rows += [{"store": found.path.name, **row} for row in named]
    show(rows, _realism_lines(rows), as_json=as_json)


def _traffic(name: str, weights: Path | None) -> Any:
    from shiftsim.sim.traffic import make_traffic

    if name == "learned" and weights:
        from shiftsim.sim.traffic.learned.model import LearnedTraffic

        return LearnedTraffic(weights)
    return make_traffic(name)


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
