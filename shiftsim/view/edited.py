"""A recorded scenario beside what an edit makes of it."""

import textwrap
from typing import Any

import numpy as np

from shiftsim.view import still
from shiftsim.world.scenario import Scenario

_EDITED = "#7b2fbf"  # as in replays
_WIDTH = 110  # characters of the words below the picture


def before_and_after(recorded: Scenario, edited: Scenario) -> Any:
    """A matplotlib figure: both at the first iteration, tracks of the edit outlined.

    Raises:
        MissingExtraError: matplotlib is missing.
    """
    points = [recorded.expert[:, :2], edited.expert[:, :2]]
    made = _made(edited)
    if len(made):
        points.append(edited.tracks.poses[edited.iteration_rows[0], made, :2])
    extent = still.extent_of_points(np.concatenate(points))
    words = edited.script.words if edited.script else ()
    lines = [part for line in words for part in textwrap.wrap(line, _WIDTH)]
    figure, (panels,) = still.panels(1, 2, extent)
    for scenario, axes in zip((recorded, edited), panels, strict=True):
        still.draw_start(axes, scenario, extent)
        axes.set_title(
            f"{scenario.token}  {scenario.scenario_type}".replace("$", r"\$"), fontsize=9
        )
    tracks, row = edited.tracks, int(edited.iteration_rows[0])
    x, y = tracks.poses[row, made, 0], tracks.poses[row, made, 1]
    ring = {"s": 90, "facecolors": "none", "edgecolors": _EDITED, "linewidths": 1.4, "zorder": 8}
    panels[1].scatter(x, y, label="edited", **ring)
    figure.supxlabel("\n".join(lines), fontsize=8)
    still.add_legend(figure, panels[1])
    return figure


def _made(edited: Scenario) -> np.ndarray:
    """Indices of the tracks that an edit made or changed and that are there at the start."""
    script, row = edited.script, int(edited.iteration_rows[0])
    names = set(script.tokens) if script else set()
    there = edited.tracks.valid[row]
    found = [name in names for name in edited.tracks.tokens]
    return np.flatnonzero(there & np.array(found, np.bool_))
