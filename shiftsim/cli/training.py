"""`shiftsim train`: making weights."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from typer import Argument, Option

from shiftsim import cli
from shiftsim.cli import Json, Quiet, echo, new_app, plural, print_result
from shiftsim.train.folder import (
    BEST,
    FeatureSettings,
    ImitationSettings,
    Settings,
    TrafficSettings,
)

app = new_app("Train networks.", no_args_is_help=True)


@app.command()
@cli.with_settings(of=Settings)
def carl(
    settings: cli.Settings,
    resume: bool = Option(False, "--resume", help="Go on where it was ended."),
    quiet: Quiet = False,
) -> None:
    """Train CaRL's network to drive as PDM-Closed does."""
    from shiftsim.planners.learned.checkpoint import require_torch

    require_torch("training")
    from shiftsim.train.recipe import Training

    chosen = Settings(**settings)
    Training(chosen, _on_message(quiet), resume=resume).run()
    _say_best("carl", chosen.out)


_LEARNT = [item for item in ImitationSettings.__dataclass_fields__ if item != "planner"]


_IMITATED = {"plantf": "PlanTF", "pluto": "PLUTO", "diffusion-planner": "Diffusion Planner"}


def _add_imitation(planner: str, words: str) -> None:
    """The command that trains a planner from recordings."""

    @app.command(planner, help=f"Train {words} from recordings.")
    @cli.with_settings(*_LEARNT, of=ImitationSettings)
    def train(
        settings: cli.Settings,
        resume: bool = Option(False, "--resume", help="Go on where it was ended."),
        quiet: Quiet = False,
    ) -> None:
        _imitate(ImitationSettings(planner=planner, **settings), resume, quiet)


for _planner, _words in _IMITATED.items():
    _add_imitation(_planner, _words)


def _imitate(chosen: ImitationSettings, resume: bool, quiet: bool) -> None:
    from shiftsim.planners.learned.checkpoint import require_torch

    require_torch("training")
    from shiftsim.train.recipe import ImitationTraining

    ImitationTraining(chosen, _on_message(quiet), resume=resume).run()
    _say_best(chosen.planner, chosen.out)


@app.command()
@cli.with_settings(of=TrafficSettings)
def traffic(settings: cli.Settings, quiet: Quiet = False) -> None:
    """Train traffic to move as recorded agents do."""
    from shiftsim.planners.learned.checkpoint import require_torch

    require_torch("training")
    from shiftsim.train.traffic.recipe import train_traffic

    chosen = TrafficSettings(**settings)
    weights = train_traffic(chosen, _on_message(quiet))
    echo(f"weights: {weights}")
    echo(f"how real it is: shiftsim realism {chosen.store} --weights {weights}")


def _say_best(planner: str, folder: Path) -> None:
    echo(f"best network: {folder / BEST}")
    echo(f"drive with it: shiftsim run -p {planner} --checkpoint {planner}={folder / BEST}")


def _on_message(quiet: bool) -> Callable[[str], None]:
    return (lambda text: None) if quiet else partial(echo, err=True)


@cli.with_settings("planner", "out", "split", "seed", "workers", "samples", of=FeatureSettings)
def features(
    settings: cli.Settings,
    store: str = Argument(help="Store by name, path or URL."),
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write samples of a store to files, to train on elsewhere."""
    from shiftsim.planners.learned.checkpoint import require_torch

    require_torch("features")
    from shiftsim.train.folder import write_features

    chosen = FeatureSettings(store=store, **settings)
    index = write_features(chosen, _on_message(quiet))
    files = plural(len(index["files"]), "file")
    lines = [f"{index['samples']} samples in {files}: {chosen.out}"]
    lines += [f"not made: {number} {reason}" for reason, number in index["failed"].items()]
    print_result(index, iter(lines), as_json=as_json)


def realism(
    stores: list[str] = Argument(help="Stores by name, path or URL."),
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
