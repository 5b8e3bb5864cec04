"""Commands that show: view, plot, inspect."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from shiftsim import cli
from shiftsim.cli import Quiet, echo, plural, progress_bar, show_in_browser
from shiftsim.cli.report import Labels, Plain, RunFolder, Serif, Width
from shiftsim.errors import ConfigError
from shiftsim.files import safe_join

if TYPE_CHECKING:
    from collections.abc import Sequence

    from shiftsim.view.build import Gallery

Others = Annotated[
    list[Path] | None,
    Option("--with", help="Another run on the same store, shown together; repeatable."),
]
Planners = Annotated[
    list[str] | None, Option("--planner", "-p", help="Only this planner; repeatable.")
]
Noises = Annotated[list[str] | None, Option("--noise", "-n", help="Only this noise; repeatable.")]
Seeds = Annotated[list[int] | None, Option("--seed", help="Only this seed; repeatable.")]
Store = Annotated[str | None, Option("--store", "-s", help="Name or folder. [the manifest's]")]
Browser = Annotated[bool, Option("--open/--no-open", help="Open the page in the browser.")]


def view(
    run: RunFolder,
    token: str | None = Argument(None, metavar="[TOKEN]", help="A scenario. [all of them]"),
    others: Others = None,
    planner: Planners = None,
    noise: Noises = None,
    seed: Seeds = None,
    store: Store = None,
    labels: Labels = None,
    limit: int = Option(200, help="Only the N with the lowest scores, 0 for all."),
    fork: bool = Option(
        False, "--fork", help="Also from where collisions could be avoided; needs TOKEN."
    ),
    out: Path | None = Option(None, help="Folder to write to. [RUN/view]"),
    browser: Browser = True,
    quiet: Quiet = False,
) -> None:
    """Replay rollouts in the browser: pages that need no server and no network."""
    from shiftsim.view.build import page_name, write_site

    if fork and token is None:
        raise ConfigError("--fork needs a scenario", hint="shiftsim view RUN TOKEN --fork")
    found = _galleries([run, *(others or ())], labels, store, planner, noise, seed)
    folder = out or safe_join(run, "view")
    if token is not None:
        gallery, token = _holding(found, token)
        folder.mkdir(parents=True, exist_ok=True)
        page = folder / page_name(token)
        for name, one in gallery.pages(token, fork=fork).items():
            one.save(folder / name)
        _say_shown(gallery, token, "the others are linked")
    else:
        with progress_bar(quiet=quiet) as advance:
            title = f"Replays of {run.name}"
            count = write_site(folder, found, title=title, limit=limit, on_progress=advance)
        left = sum(len(gallery.tokens) for gallery in found) - count
        echo(f"{plural(count, 'replay')}{f', {left} more with --limit 0' if left else ''}")
        page = folder / "index.html"
    echo(f"written: {page}")
    if browser:
        show_in_browser(page.resolve().as_uri())


def plot(
    run: RunFolder,
    token: str | None = Argument(None, metavar="[TOKEN]", help="A scenario."),
    at: str = Option("0", help="Time of a still from the start [s]; several, such as 0,5,10."),
    grid: bool = Option(False, "--grid", help="A row per rollout, a column per time."),
    width: Width = None,
    serif: Serif = False,
    plain: Plain = False,
    speed: float = Option(1.0, help="How much faster than time a film is."),
    open_against_closed: bool = Option(
        False,
        "--open-against-closed",
        help="In place of a scenario: open-loop against closed-loop scores of all of them.",
    ),
    out: Path = Option(
        Path("figure.pdf"), "--out", "-o", help="A .pdf, .png or .svg, or a film: .mp4 or .gif."
    ),
    others: Others = None,
    planner: Planners = None,
    noise: Noises = None,
    seed: Seeds = None,
    store: Store = None,
    labels: Labels = None,
    quiet: Quiet = False,
) -> None:
    """The driven paths of several rollouts over the map, as a still or a film."""
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.report.figures import open_against_closed as scatter
    from shiftsim.report.palette import FigureFormat, save_picture
    from shiftsim.view.still import FILMS, save_figure

    form = FigureFormat.of(width, serif=serif, plain=plain)
    if open_against_closed:
        opened = open_runs([run, *(others or ())], labels or ())
        save_picture(scatter(opened.groups(allow_partial=True), form=form).drawn, out)
        echo(f"written: {out}")
        return
    if token is None:
        raise ConfigError("no scenario", hint="shiftsim plot RUN TOKEN, or --open-against-closed")
    found = _galleries([run, *(others or ())], labels, store, planner, noise, seed)
    gallery, token = _holding(found, token)
    scenario = gallery.store.read(token)
    shown = gallery.shown(token, scenario)
    form = form._replace(note=gallery.shown_words(token))
    how: dict[str, Any] = {"at": _times(at), "in_grid": grid, "form": form}
    with progress_bar(quiet=quiet or out.suffix.lower() not in FILMS) as advance:
        save_figure(out, scenario, shown, **how, speed=speed, on_progress=advance)
    _say_shown(gallery, token, "--planner, --noise and --seed choose others")
    echo(f"written: {out}")


def _say_shown(gallery: "Gallery", token: str, others: str) -> None:
    """Say what is drawn of how much, where that is not all."""
    if words := gallery.shown_words(token):
        echo(f"{words}{f'; {others}' if len(gallery.parts(token)) > 1 else ''}")


def _times(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError as error:
        raise ConfigError(
            f"times {text!r} are not numbers", hint="--at 5, or --at 0,5,10"
        ) from error


def inspect(
    store: str = Argument(metavar="STORE", help="Name or folder of a store."),
    reviewer: str = Option("", help="Who reviews. [the login name]"),
    port: int = Option(0, help="Port on this machine, 0 for a free one."),
    browser: Browser = True,
) -> None:
    """Review scenarios in the browser: accept, reject, comment, correct the route."""
    from shiftsim.data.store.tables import REVIEW
    from shiftsim.view.review import ReviewService, review_server

    if "://" in store:  # where the source's own review would take the place of what is decided
        raise ConfigError(f"store {store!r} is behind a URL", "review a copy of its folder")
    path = cli.open_store(store).path
    with review_server(ReviewService(path, reviewer), port) as server:
        echo(f"review     {server.address}")
        echo(f"kept in    {path / REVIEW}")
        echo("stop with Ctrl-C; what was decided is on disk")
        if browser:
            show_in_browser(server.address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            echo()


def _galleries(
    folders: list[Path],
    labels: list[str] | None,
    store: str | None,
    *chosen: "Sequence[Any] | None",
) -> "list[Gallery]":
    """The rollouts of runs and benchmarks by planner, noise and seed, a gallery for each store."""
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.runs.scenarios import open_run_store
    from shiftsim.view.build import Choice, galleries

    runs = open_runs(folders, labels or ()).runs
    choice = Choice(*(tuple(values or ()) for values in chosen))
    return galleries(runs, [open_run_store(run, store) for run in runs], choice)


def _holding(found: "list[Gallery]", token: str) -> "tuple[Gallery, str]":
    """The gallery that holds a scenario, and its whole token."""
    *others, last = found
    for gallery in others:
        with suppress(ConfigError):
            return gallery, gallery.find(token)
    return last, last.find(token)
