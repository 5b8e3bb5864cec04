"""Compare shiftsim with a folder of reference outputs, recognised by its content.

Every part fills a `Report`; nothing here decides what is equal but the tolerances of the folders'
READMEs and of the project's own promise, whichever is tighter.
"""

from importlib import import_module
from inspect import signature
from pathlib import Path

from shiftsim.errors import DataError
from shiftsim.verify.files import COMPARED
from shiftsim.verify.report import Report

MODES = ("NR", "R", "PT")
KINDS: dict[str, list[str]] = COMPARED["kinds"]


def verify(
    folder: Path,
    *,
    kind: str | None = None,
    mode: str | None = None,
    scenes: Path | None = None,
    maps: Path | None = None,
    store: str | None = None,
) -> Report:
    """Report on a comparison of everything in a reference folder with what shiftsim computes.

    Args:
        folder: Reference folder.
        kind: Which of `KINDS` it is; by default it is recognised by its content.
        mode: Only runs of this challenge (`NR`, `R` or `PT`); None for all.
        scenes: Folder with the logs and maps that other folders refer to; by default a folder
            `nuplan` beside `folder`.
        maps: Folder with OpenDRIVE maps; by default a folder `maps` beside the parent of `folder`.
        store: Store with the scenarios of nuPlan's results, by name, path or URL.

    Raises:
        DataError: The folder is of no known kind, or a file in it is broken.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    options = {"scenes": scenes, "maps": maps, "store": store}
    for name, (module, *patterns) in KINDS.items():
        fits = all(any(any(folder.glob(p)) for p in either.split("|")) for either in patterns)
        if name == kind or (kind is None and fits):
            part = getattr(import_module(f"shiftsim.verify.{module}"), f"verify_{name}")
            report, takes = Report(mode), signature(part).parameters
            part(folder, report, **{name: options[name] for name in options if name in takes})
            return report
    raise DataError(
        f"{folder}: not recognised as a folder of reference outputs",
        hint=f"known kinds: {', '.join(KINDS)}",
    )
