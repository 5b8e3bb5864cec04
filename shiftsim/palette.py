"""How planners look in every picture: a colour, a marker and a dash of their own.

The colours stay apart under the common kinds of colour-blindness; in grey, where some come close,
marker and dash tell them apart.
"""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Look:
    """How one planner is drawn.

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
    "log-future": Look("#6e6e6e", "o"),
    "carl": Look("#0b62c4", "s"),
    "diffusion-planner": Look("#e08a00", "^"),
    "pluto": Look("#c4121a", "D"),
    "plantf": Look("#7a3fa8", "v"),
    "pdm-closed": Look("#12855a", "P"),
    "idm": Look("#2fa8d5", "X"),
    "constant-velocity": Look("#7c5a1e", "*"),
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

    A name may end in a remark, as in `idm (reactive)`; the first of a planner's names gets its look.
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
