"""What all pictures share: matplotlib, and how planners, noise, the recorded driver are drawn.

Colour and marker are the planner. A clean rollout has a solid line and full marks, a disturbed one
a dashed line and hollow marks, in curves, stills and replays alike. The recorded driver is dotted,
in a colour of no planner.

The colours of the known planners were searched for being far apart in every pair: at least 18 in
CIELAB to normal eyes and under all kinds of colour-blindness, at least 6 in lightness in grey.
Markers tell planners apart without any colour.
"""

import re
from collections.abc import Callable, Iterable
from functools import wraps
from itertools import cycle
from pathlib import Path
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar

from shiftsim.errors import ConfigError, import_extra
from shiftsim.files import atomic_write
from shiftsim.world.state import AgentKind

COLUMN, PAGE = 3.5, 7.0  # inches, one column and both columns of a paper
SMALL, TEXT = 7.0, 8.0  # points at that width; nothing is smaller
_INCHES = {"in": 1.0, "": 1.0, "cm": 1 / 2.54, "mm": 1 / 25.4, "pt": 1 / 72.27}
_SERIF = {"font.family": ["STIXGeneral", "DejaVu Serif"]}
_DPI = 200
_Call = ParamSpec("_Call")
_Made = TypeVar("_Made")
_LITERAL = {"text.parse_math": False}  # names may hold dollars
_PLAIN = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


class FigureFormat(NamedTuple):
    """How a figure is laid out for the page that it is meant for."""

    width: float = 0.0  # inches; 0 for the figure's own
    serif: bool = False  # letters as in the text of a paper
    plain: bool = False  # without title and notes, which a caption says
    note: str = ""  # what a figure of a scenario leaves out

    @classmethod
    def of(
        cls, width: float | str | None = None, *, serif: bool = False, plain: bool = False
    ) -> "FigureFormat":
        """A format of a width [inches], or with a unit as in `89mm`, or a ConfigError."""
        found = re.fullmatch(r"(\d+\.?\d*) ?(in|cm|mm|pt|)", str(width or 0))
        inches = float(found[1]) * _INCHES[found[2]] if found else 0.0
        if width is not None and not 2.0 <= inches <= 40.0:
            raise ConfigError(f"{width!r} is no width of a figure", "--width 3.5in, 7in, 89mm …")
        return cls(inches, serif, plain)


DEFAULT_FORM = FigureFormat()


def in_format(draw: Callable[_Call, _Made]) -> Callable[_Call, _Made]:
    """Let a function draw with the letters that its argument `form`, a `FigureFormat`, names."""

    @wraps(draw)
    def call(*values: _Call.args, **named: _Call.kwargs) -> _Made:
        matplotlib = _matplotlib()
        is_serif = getattr(named.get("form"), "serif", False)
        with matplotlib.rc_context(_LITERAL | (_SERIF if is_serif else {})):
            return draw(*values, **named)

    return call


def new_figure(
    layout: Literal["constrained", "compressed"] | None = "constrained", **settings: Any
) -> Any:
    """An empty figure that can be measured; a MissingExtraError without matplotlib."""
    _matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(layout=layout, **settings)
    FigureCanvasAgg(figure)
    return figure


def _matplotlib() -> Any:
    found: Any = import_extra("matplotlib", "plots")
    found.rcParams.update({"svg.hashsalt": "shiftsim", "pdf.fonttype": 42})
    return found


def characters(width: float, size: float = SMALL) -> int:
    """How many characters of a size [points] surely fit into a width [inch]."""
    return int(width * 72.0 / (0.58 * size))


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure, with equal bytes for equal ones; a ConfigError if the ending is unknown."""
    kind = path.suffix.lower()
    if kind[1:] not in figure.canvas.get_supported_filetypes():
        raise ConfigError(f"{path}: no picture ends in {kind!r}", hint="use .png, .svg or .pdf")
    with atomic_write(path) as partial:
        figure.savefig(partial, dpi=_DPI, format=kind[1:] or None, metadata=_PLAIN.get(kind))


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
    """A style per planner, its own (also with a remark, as in `idm (reactive)`) or the next one.

    Others have theirs in the order of their names, whatever the order in which they are drawn.
    """
    out: dict[str, Style] = {}
    planners, others = list(planners), cycle(_OTHERS)
    for name in sorted(set(planners)):
        style = _KNOWN.get(name.partition(" (")[0])
        out[name] = next(others) if style is None or style in out.values() else style
    return {name: out[name] for name in dict.fromkeys(planners)}
