"""Small OpenDRIVE files, written by hand in a few words."""

from collections.abc import Sequence

from shiftsim.data.maps.opendrive.reading import parse_opendrive
from shiftsim.data.maps.opendrive.records import OpenDrive


def geometry(
    shape: str, *, s: float = 0, x: float = 0, y: float = 0, hdg: float = 0, length: float = 100
) -> str:
    """One geometry record around the XML of its shape."""
    return f'<geometry s="{s}" x="{x}" y="{y}" hdg="{hdg}" length="{length}">{shape}</geometry>'


def lane(
    number: int,
    kind: str = "driving",
    width: float = 3.5,
    inner: str = "",
    before: int | None = None,
    after: int | None = None,
) -> str:
    """One lane of constant width; `before` and `after` are its links, `inner` is more XML."""
    links = "" if before is None else f'<predecessor id="{before}"/>'
    links += "" if after is None else f'<successor id="{after}"/>'
    record = f'<width sOffset="0" a="{width}" b="0" c="0" d="0"/>' if width else ""
    return f'<lane id="{number}" type="{kind}"><link>{links}</link>{record}{inner}</lane>'


def section(*lanes: str, s: float = 0) -> str:
    """One lane section; lanes need not be sorted into left and right."""
    return f'<laneSection s="{s}"><right>{"".join(lanes)}</right></laneSection>'


def road(
    name: str = "1",
    *,
    plan: str | Sequence[str] = "",
    sections: str = "",
    length: float = 100,
    junction: str = "-1",
    link: str = "",
    inner: str = "",
    rule: str = "RHT",
    offsets: str = "",
) -> str:
    """One road; a straight one along x with a lane in each direction unless told otherwise."""
    records = "".join(plan) or geometry("<line/>", length=length)
    sections = sections or section(lane(1), lane(-1))
    return (
        f'<road id="{name}" length="{length}" junction="{junction}" rule="{rule}">'
        f"<link>{link}</link><planView>{records}</planView>"
        f"<lanes>{offsets}{sections}</lanes>{inner}</road>"
    )


def touches(end: str, element: str, name: str, contact: str = "") -> str:
    """A road link: `end` is predecessor or successor."""
    at = f' contactPoint="{contact}"' if contact else ""
    return f'<{end} elementType="{element}" elementId="{name}"{at}/>'


def connection(incoming: str, connecting: str, contact: str, *links: tuple[int, int]) -> str:
    """One connection of a junction."""
    pairs = "".join(f'<laneLink from="{a}" to="{b}"/>' for a, b in links)
    return (
        f'<connection id="0" incomingRoad="{incoming}" connectingRoad="{connecting}"'
        f' contactPoint="{contact}">{pairs}</connection>'
    )


def document(*parts: str, header: str = '<header revMajor="1" revMinor="7"/>') -> bytes:
    """A whole file."""
    return f'<?xml version="1.0"?><OpenDRIVE>{header}{"".join(parts)}</OpenDRIVE>'.encode()


def parse(*parts: str) -> OpenDrive:
    """The records of a file of these parts."""
    return parse_opendrive(document(*parts), "test.xodr")


def crossroads(turn: float = 0.0, x: float = 0.0, y: float = 0.0) -> bytes:
    """Two roads of 50 m in a row with a junction of 20 m between, and a side road to the right.

    The whole file is turned about the origin and moved.
    """
    import math

    cos, sin = math.cos(turn), math.sin(turn)

    def placed(shape: str, px: float, py: float, hdg: float, length: float) -> str:
        return geometry(
            shape,
            x=x + cos * px - sin * py,
            y=y + sin * px + cos * py,
            hdg=hdg + turn,
            length=length,
        )

    quarter = 10 * math.pi / 2
    return document(
        road(
            "1",
            length=50,
            plan=placed("<line/>", 0, 0, 0, 50),
            link=touches("successor", "junction", "9"),
        ),
        road(
            "2",
            length=50,
            plan=placed("<line/>", 70, 0, 0, 50),
            link=touches("predecessor", "junction", "9"),
        ),
        road(
            "3",
            length=50,
            plan=placed("<line/>", 60, -10, -math.pi / 2, 50),
            link=touches("predecessor", "junction", "9"),
        ),
        road(
            "10",
            length=20,
            junction="9",
            plan=placed("<line/>", 50, 0, 0, 20),
            sections=section(lane(1, before=1, after=1), lane(-1, before=-1, after=-1)),
            link=touches("predecessor", "road", "1", "end")
            + touches("successor", "road", "2", "start"),
        ),
        road(
            "11",
            length=quarter,
            junction="9",
            plan=placed('<arc curvature="-0.1"/>', 50, 0, 0, quarter),
            sections=section(lane(-1, before=-1, after=-1)),
            link=touches("predecessor", "road", "1", "end")
            + touches("successor", "road", "3", "start"),
        ),
        '<junction id="9" name="">'
        + connection("1", "10", "start", (-1, -1))
        + connection("2", "10", "end", (1, 1))
        + connection("1", "11", "start", (-1, -1))
        + "</junction>",
    )
