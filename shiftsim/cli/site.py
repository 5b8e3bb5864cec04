"""The report as a folder of pages: tables and pictures, and every scenario with its replay."""

import html
from collections.abc import Callable, Sequence
from pathlib import Path

from shiftsim.report.figures import Figure
from shiftsim.report.tables import Table
from shiftsim.report.writers import render
from shiftsim.runs.bundle import open_run_store
from shiftsim.runs.results import Run
from shiftsim.view.build import Choice, galleries, write_site


def write_report_site(
    folder: Path,
    runs: Sequence[Run],
    tables: Sequence[Table],
    drawn: Sequence[Figure],
    *,
    limit: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Write the folder; it opens from disk and from any static server.

    Args:
        folder: Where to; made if needed.
        runs: The runs of the report; those without stored rollouts have no replays.
        tables: Its tables.
        drawn: Its pictures.
        limit: At most so many replays, the lowest scores first; 0 for all.
        on_progress: Called with the number of replays made and their total.

    Returns:
        The page to open.

    Raises:
        DataError: The store of a run is not there any more, or is another one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    parts = [render(table, "html") for table in tables]
    for figure in drawn:
        picture = figure.save(folder)
        name, title = html.escape(picture.name), html.escape(figure.title)
        parts.append(f'<figure><img src="{name}" alt="{title}"></figure>')
    stored = [run for run in runs if any(run.rollout_places.values())]
    stores = [open_run_store(run) for run in stored]
    write_site(
        folder,
        galleries(stored, stores, Choice()),
        title=", ".join(run.path.name for run in runs),
        limit=limit,
        above="\n".join(parts),
        on_progress=on_progress,
    )
    return folder / "index.html"
