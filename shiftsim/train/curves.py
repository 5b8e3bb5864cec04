"""What a training writes about itself: tables, and a picture of them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.files import whole_file

Say = Callable[[str], None]


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows as Parquet."""
    with whole_file(path) as partial:
        pq.write_table(pa.Table.from_pylist(rows), partial)


def draw_curves(path: Path, curve: list[dict[str, Any]], scores: list[dict[str, Any]]) -> None:
    """Draw errors while training, and scores after each round; nothing without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    samples = [row["samples"] / 1e6 for row in curve]
    for name, factor in (("acceleration_error", 1.0), ("steering_error", 10.0)):
        label = name.replace("_", " ") + (f" x {factor:g}" if factor != 1.0 else "")
        left.plot(samples, [factor * row[name] for row in curve], label=label, linewidth=0.9)
    left.set(xlabel="samples [million]", ylabel="mean absolute error", yscale="log")
    left.legend(frameon=False)
    at = [row["samples"] / 1e6 for row in scores]
    for noise in ("none", "ou-high"):
        right.plot(at, [100.0 * row[noise] for row in scores], marker="o", label=f"noise {noise}")
    right.set(xlabel="samples [million]", ylabel="CLS on towns left out", ylim=(0, 100))
    right.legend(frameon=False, loc="lower right")
    with whole_file(path) as partial:
        figure.savefig(partial, format="png", dpi=100)
