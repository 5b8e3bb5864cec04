"""What `import shiftsim` offers that joins layers which may not import one another.

The other public names are where they are defined; `shiftsim/__init__.py` lists all of them.
"""

import html
from typing import Any

from shiftsim.report.scores import score_table, worst_rollouts
from shiftsim.runs import execute, results
from shiftsim.runs.scenarios import open_run_store
from shiftsim.view.build import Gallery
from shiftsim.view.page import Page


class Run(results.Run):
    """A finished run on disk, with its tables and pictures."""

    def table(self, *, allow_partial: bool = False) -> str:
        """The score table as text."""
        return score_table([self], allow_partial=allow_partial)

    def worst(self, count: int = 10) -> list[dict[str, Any]]:
        """The rollouts with the lowest scores: key, `cls` and `reason`."""
        return worst_rollouts(self, count)

    def view(self, token: str) -> Page:
        """The replay of one scenario: a page that notebooks show, and that has `.save(path)`.

        Raises:
            ConfigError: There is no stored rollout of it.
            DataError: The store of the run is not there.
        """
        gallery = Gallery([self], open_run_store(self))
        return gallery.page(gallery.find(token))

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})\n{self.table()}"

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(self.table())}</pre>"


def run(planner: Any, **settings: Any) -> Run:
    """As `shiftsim.runs.execute.run`, which describes the arguments."""
    done = execute.run(planner, **settings)
    return Run(done.path, done.manifest)


def open_run(path: str) -> Run:
    """As `shiftsim.runs.results.open_run`."""
    found = results.open_run(path)
    return Run(found.path, found.manifest)
