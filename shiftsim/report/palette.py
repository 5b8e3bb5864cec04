"""What all pictures share: matplotlib, and how planners look.

The colours of the known planners were searched for being far apart in every pair: at least 18 in
CIELAB to normal eyes and under all kinds of colour-blindness, at least 6 in lightness in grey.
Markers, and dashes where lines are drawn, tell planners apart without any colour.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shiftsim.errors import MissingExtraError

_PLAIN = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


def new_figure(**settings: Any) -> Any:
    """An empty figure of matplotlib; ids in SVG files are always the same.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError(
            "pictures need matplotlib", hint="pip install 'shiftsim[plots]'"
        ) from error
    matplotlib.rcParams["svg.hashsalt"] = "shiftsim"
    return Figure(layout="constrained", **settings)


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure without time stamps: the same picture has the same bytes."""
    figure.savefig(path, dpi=150, metadata=_PLAIN.get(path.suffix.lower()))


@dataclass(frozen=True, slots=True)
class Look:
    """How one planner is drawn: a colour, a marker and a dash of its own.

    Attributes:
        colour: As `#rrggbb`.
        marker: Name of its marker in matplotlib: `o s ^ D v P X *`.
        dash: Lengths of line and gap in points; empty for a solid line.
    """

    colour: str
    marker: str
    dash: tuple[float, ...] = ()


# the planners of the paper in its colours' names: log grey, CaRL blue, Diffusion Planner orange,
# PLUTO red, PlanTF purple, PDM-Closed green
_KNOWN = {
    "log-future": Look("#787878", "o"),
    "carl": Look("#125ced", "s"),
    "diffusion-planner": Look("#f09a1e", "^"),
    "pluto": Look("#840e17", "D"),
    "plantf": Look("#411e6d", "v"),
    "pdm-closed": Look("#2d9b62", "P"),
    "idm": Look("#26576c", "X"),
    "constant-velocity": Look("#bf9647", "*"),
}
_OTHERS = (
    Look("#c2569a", "o", (6, 2)),
    Look("#1f3a70", "s", (6, 2)),
    Look("#8a9a12", "^", (6, 2)),
    Look("#d2691e", "D", (6, 2)),
    Look("#0f8f96", "v", (6, 2)),
    Look("#4d4d4d", "P", (6, 2)),
)


def looks(planners: Iterable[str]) -> dict[str, Look]:
    """A look per planner; those without one of their own get one by their order.

    A name may end in a remark, as in `idm (reactive)`; the first of these has the planner's look.
    """
    out: dict[str, Look] = {}
    others = 0
    for name in dict.fromkeys(planners):
        look = _KNOWN.get(name.partition(" (")[0])
        if look is None or look in out.values():
            look = _OTHERS[others % len(_OTHERS)]
            others += 1
        out[name] = look
    return out
