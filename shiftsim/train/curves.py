"""What a training writes about itself: tables, and a picture of them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.errors import MissingExtraError
from shiftsim.files import atomic_write
from shiftsim.report.palette import dashes, new_figure, planner_styles, save_picture

Say = Callable[[str], None]


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows as Parquet."""
    with atomic_write(path) as partial:
        pq.write_table(pa.Table.from_pylist(rows), partial)


def draw_curves(path: Path, curve: list[dict[str, Any]], scores: list[dict[str, Any]]) -> None:
    """Draw errors while training, and scores after each round; nothing without matplotlib."""
    try:
        figure = new_figure(figsize=(8.0, 3.2))
    except MissingExtraError:
        return
    left, right = figure.subplots(1, 2)
    samples = [row["samples"] / 1e6 for row in curve]
    for name, factor, colour in (("acceleration", 1.0, "0.15"), ("steering", 10.0, "0.6")):
        values = [factor * row[f"{name}_error"] for row in curve]
        label = f"{name} error" + (f" × {factor:g}" if factor != 1.0 else "")
        left.plot(samples, values, label=label, color=colour, linewidth=0.9)
    left.set(xlabel="samples [million]", ylabel="mean absolute error", yscale="log")
    left.legend(frameon=False, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    at = [row["samples"] / 1e6 for row in scores]
    style = planner_styles(["carl"])["carl"]
    for noise in ("none", "ou-high"):
        look = {"label": f"noise {noise}", "linestyle": dashes(noise), **style.marks(noise)}
        right.plot(at, [100.0 * row[noise] for row in scores], **look)
    right.set(xlabel="samples [million]", ylim=(0, 100))
    right.set_ylabel("closed-loop score × 100")
    right.set_title("on towns left out", fontsize=9)
    right.legend(frameon=False, loc="lower right")
    save_picture(figure, path)
