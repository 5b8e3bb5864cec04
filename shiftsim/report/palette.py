"""What all pictures share: matplotlib, and how planners, noise, the recorded driver are drawn.

Colour and marker are the planner. A clean rollout has a solid line and full marks, a disturbed one
a dashed line and hollow marks, in curves, stills and replays alike. The recorded driver is dotted,
in a colour of no planner.

The colours of the known planners were searched for being far apart in every pair: at least 18 in
CIELAB to normal eyes and under all kinds of colour-blindness, at least 6 in lightness in grey.
Markers tell planners apart without any colour.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple

from shiftsim.errors import import_extra
from shiftsim.files import atomic_write
from shiftsim.world.state import AgentKind

_PLAIN = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


def new_figure(
    layout: Literal["constrained", "compressed"] = "constrained", **settings: Any
) -> Any:
    """An empty figure of matplotlib that can be measured.

    Ids in SVG files are always the same; PDF files hold their fonts as TrueType, as papers ask for.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    matplotlib: Any = import_extra("matplotlib", "plots")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    matplotlib.rcParams.update({"svg.hashsalt": "shiftsim", "pdf.fonttype": 42})
    figure = Figure(layout=layout, **settings)
    FigureCanvasAgg(figure)
    return figure


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure without time stamps: the same picture has the same bytes."""
    kind = path.suffix.lower()
    with atomic_write(path) as partial:
        figure.savefig(partial, dpi=150, format=kind[1:] or None, metadata=_PLAIN.get(kind))


RECORDED = "#1f1f1f"  # the recorded driver
ALARM = "#b00020"  # violations
AGENTS = {
    AgentKind.VEHICLE: "#566b80",
    AgentKind.PEDESTRIAN: "#a8791e",
    AgentKind.BICYCLE: "#8a5f9e",
}
OTHER_AGENT = "#8f8f8f"
_SIZES = {"*": 1.7, "P": 1.2, "X": 1.2, "D": 0.85}  # markers of equal weight to the eye


class Style(NamedTuple):
    """How one planner is drawn: colour as `#rrggbb`, and the name of its marker in matplotlib."""

    colour: str
    marker: str

    def marks(self, noise: str, size: float = 6.0) -> dict[str, Any]:
        """Settings of matplotlib for the marks of a clean or a disturbed rollout [points]."""
        is_clean = noise == "none"
        return {
            "color": self.colour,
            "marker": self.marker,
            "markersize": size * _SIZES.get(self.marker, 1.0),
            "markerfacecolor": self.colour if is_clean else "white",
            "markeredgecolor": "white" if is_clean else self.colour,
            "markeredgewidth": 0.5 if is_clean else 1.1,
        }


# the planners of the paper in its colours' names: log grey, CaRL blue, Diffusion Planner orange,
# PLUTO red, PlanTF purple, PDM-Closed green
_KNOWN = {
    "log-future": Style("#787878", "o"),
    "carl": Style("#125ced", "s"),
    "diffusion-planner": Style("#f09a1e", "^"),
    "pluto": Style("#840e17", "D"),
    "plantf": Style("#411e6d", "v"),
    "pdm-closed": Style("#2d9b62", "P"),
    "idm": Style("#26576c", "X"),
    "constant-velocity": Style("#bf9647", "*"),
}
# of planners without a style: markers and hues of none of the known ones
_OTHERS = (
    Style("#c2569a", ">"),
    Style("#8a9310", "p"),
    Style("#2218dc", "<"),
    Style("#b84514", "h"),
    Style("#0c6e5f", "d"),
    Style("#254a1c", "H"),
)


def dashes(noise: str) -> Literal["-", "--"]:
    """Line style of matplotlib for a clean or a disturbed rollout."""
    return "-" if noise == "none" else "--"


def planner_styles(planners: Iterable[str]) -> dict[str, Style]:
    """A style per planner; those without one of their own get one by their order.

    A name may end in a remark, as in `idm (reactive)`; the first of these has the planner's style.
    """
    out: dict[str, Style] = {}
    others = 0
    for name in dict.fromkeys(planners):
        style = _KNOWN.get(name.partition(" (")[0])
        if style is None or style in out.values():
            style = _OTHERS[others % len(_OTHERS)]
            others += 1
        out[name] = style
    return out
