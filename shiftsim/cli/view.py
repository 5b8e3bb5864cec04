"""Commands that show: view, plot, inspect."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from shiftsim.cli import Quiet, plural, progress_bar, say, show_in_browser
from shiftsim.cli.report import RunFolder
from shiftsim.errors import ConfigError

if TYPE_CHECKING:
    from shiftsim.view.build import Gallery

Others = Annotated[
    list[Path] | None,
    typer.Option("--with", help="Another run on the same store, shown together; repeatable."),
]
Planners = Annotated[
    list[str] | None, typer.Option("--planner", "-p", help="Only this planner; repeatable.")
]
Noises = Annotated[
    list[str] | None, typer.Option("--noise", "-n", help="Only this noise; repeatable.")
]
Seeds = Annotated[
    list[int] | None, typer.Option("--seed", help="Only this seed; repeatable. [the first]")
]
Store = Annotated[
    str | None, typer.Option("--store", "-s", help="Name or folder. [the manifest's]")
]


def view(
    run: RunFolder,
    token: Annotated[
        str | None, typer.Argument(metavar="[TOKEN]", help="A scenario. [all of them]")
    ] = None,
    others: Others = None,
    planner: Planners = None,
    noise: Noises = None,
    seed: Seeds = None,
    store: Store = None,
    limit: Annotated[int, typer.Option(help="Only the N with the lowest scores, 0 for all.")] = 200,
    out: Annotated[Path | None, typer.Option(help="Folder to write to. [RUN/view]")] = None,
    browser: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in the browser.")
    ] = True,
    quiet: Quiet = False,
) -> None:
    """Replay rollouts in the browser: pages that need no server and no network."""
    from shiftsim.files import safe_join
    from shiftsim.view.build import page_name, write_site

    found = _galleries([run, *(others or ())], planner, noise, seed, store)
    folder = out or safe_join(run, "view")
    if token is not None:
        gallery, token = _holding(found, token)
        folder.mkdir(parents=True, exist_ok=True)
        page = folder / page_name(token)
        gallery.page(token).save(page)
    else:
        with progress_bar(quiet=quiet) as advance:
            count = write_site(
                folder,
                found,
                title=f"Replays of {run.name}",
                limit=limit,
                on_progress=advance,
            )
        left = sum(len(gallery.tokens) for gallery in found) - count
        say(f"{plural(count, 'replay')}{f', {left} more with --limit 0' if left else ''}")
        page = folder / "index.html"
    say(f"written: {page}")
    if browser:
        show_in_browser(page.resolve().as_uri())


def plot(
    run: RunFolder,
    token: Annotated[str, typer.Argument(metavar="TOKEN", help="A scenario.")],
    at: Annotated[
        str, typer.Option(help="Time of a still from the start [s]; several, such as 0,5,10.")
    ] = "0",
    grid: Annotated[
        bool, typer.Option("--grid", help="A row per rollout, a column per time.")
    ] = False,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="A .pdf, .png or .svg, or a film: .mp4 or .gif.")
    ] = Path("figure.pdf"),
    others: Others = None,
    planner: Planners = None,
    noise: Noises = None,
    seed: Seeds = None,
    store: Store = None,
) -> None:
    """The driven paths of several rollouts over the map, as a still or a film."""
    from shiftsim.view.still import save_figure

    found = _galleries([run, *(others or ())], planner, noise, seed, store)
    gallery, token = _holding(found, token)
    scenario = gallery.store.read(token)
    save_figure(out, scenario, gallery.shown(token, scenario), at=_times(at), in_grid=grid)
    say(f"written: {out}")


def _times(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError as error:
        raise ConfigError(
            f"times {text!r} are not numbers", hint="--at 5, or --at 0,5,10"
        ) from error


def inspect(
    store: Annotated[str, typer.Argument(metavar="STORE", help="Name or folder of a store.")],
    reviewer: Annotated[str, typer.Option(help="Who reviews. [the login name]")] = "",
    port: Annotated[int, typer.Option(help="Port on this machine, 0 for a free one.")] = 0,
    browser: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in the browser.")
    ] = True,
) -> None:
    """Review scenarios in the browser: accept, reject, comment, correct the route."""
    from shiftsim.data.store.tables import REVIEW
    from shiftsim.runs.scenarios import open_named_store
    from shiftsim.view.review import ReviewServer, ReviewService

    path = open_named_store(store).path
    with ReviewServer(ReviewService(path, reviewer), port) as server:
        say(f"review     {server.address}")
        say(f"kept in    {path / REVIEW}")
        say("stop with Ctrl-C; what was decided is on disk")
        if browser:
            show_in_browser(server.address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            say()


def _galleries(
    folders: list[Path],
    planner: list[str] | None,
    noise: list[str] | None,
    seed: list[int] | None,
    store: str | None,
) -> "list[Gallery]":
    """The rollouts of runs and benchmarks, one gallery for each store."""
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.runs.scenarios import open_run_store
    from shiftsim.view.build import Choice, galleries

    runs, *_ = open_runs(folders)
    choice = Choice(tuple(planner or ()), tuple(noise or ()), tuple(seed or ()))
    return galleries(runs, [open_run_store(run, store) for run in runs], choice)


def _holding(found: "list[Gallery]", token: str) -> "tuple[Gallery, str]":
    """The gallery that holds a scenario, and its whole token."""
    *others, last = found
    for gallery in others:
        with suppress(ConfigError):
            return gallery, gallery.find(token)
    return last, last.find(token)
