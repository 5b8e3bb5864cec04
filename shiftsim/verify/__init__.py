"""Compare shiftsim with a folder of reference outputs, recognised by its content.

Every part fills a `Report`; nothing here decides what is equal but the tolerances of the folders'
READMEs and of the project's own promise, whichever is tighter.
"""

from pathlib import Path

from shiftsim.errors import DataError
from shiftsim.verify.kinds import KINDS
from shiftsim.verify.report import Report

MODES = ("NR", "R", "PT")


def verify(
    folder: Path, *, mode: str | None = None, scenes: Path | None = None, maps: Path | None = None
) -> Report:
    """Compare everything in a reference folder with what shiftsim computes.

    Args:
        folder: Reference folder.
        mode: Only runs of this challenge (`NR`, `R` or `PT`); None for all.
        scenes: Folder with the logs and maps that other folders refer to; by default a folder
            `nuplan` beside `folder`.
        maps: Folder with OpenDRIVE maps; by default a folder `maps` beside the parent of `folder`.

    Returns:
        The report.

    Raises:
        DataError: The folder is of no known kind, or a file in it is broken.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    for kind in KINDS:
        if kind.matches(folder):
            report = Report()
            kind.verify(folder, report, mode=mode, scenes=scenes, maps=maps)
            return report
    raise DataError(
        f"{folder}: not recognised as a folder of reference outputs",
        hint=f"known kinds: {', '.join(kind.name for kind in KINDS)}",
    )
