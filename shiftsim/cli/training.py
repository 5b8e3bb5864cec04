"""`shiftsim train`: making weights."""

from pathlib import Path
from typing import Annotated

import typer

from shiftsim.cli import Debug, Quiet, new_app, say

app = new_app("Train networks.")


@app.command()
def carl(
    out: Annotated[Path, typer.Option(help="Folder for networks, curves and what was collected.")],
    store: Annotated[str, typer.Option(help="Store by name, path or URL.")] = "demo",
    split: Annotated[
        str, typer.Option(help="Split of the store; all its scenarios if empty.")
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
    debug: Debug = False,
) -> None:
    """Train CaRL's network to drive as PDM-Closed does."""
    from shiftsim.planners.learned.device import require_torch

    require_torch("training")
    from shiftsim.train.recipe import Training
    from shiftsim.train.settings import Settings

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
    shown = (lambda text: None) if quiet else (lambda text: typer.echo(text, err=True))
    training = Training(settings, shown, resume=resume)
    training.run()
    say(f"best network: {settings.best}")
    say(f"drive with it: shiftsim run -p carl --checkpoint carl={settings.best}")
