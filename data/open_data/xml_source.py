"""An XML file of an open data set: its root, and numbers, lines and references of its elements."""

from pathlib import Path
from typing import Any

from lxml import etree

from shiftsim.arrays import FloatArray
from shiftsim.data.open_data.source import Source


class XmlSource(Source):
    """An XML file. Entities and document types are refused."""

    def __init__(self, path: Path, max_bytes: int) -> None:
        """Reads it all, without comments."""
        super().__init__(path)
        parser = etree.XMLParser(
            resolve_entities=False,
            no_network=True,
            load_dtd=False,
            huge_tree=False,
            remove_comments=True,
            remove_pis=True,
        )
        try:
            self.root: Any = etree.fromstring(self.content(max_bytes), parser)
        except (etree.XMLSyntaxError, ValueError) as error:
            raise self.fault(f"not well-formed XML ({error})") from error
        if self.root.getroottree().docinfo.doctype:
            raise self.fault("has a DOCTYPE", "remove it and its entities")

    def number_at(self, element: Any, path: str, field: str, place: str) -> float:
        """The number at a path below an element."""
        return self.number(element.findtext(path), field, f"{place}: {path!r}")

    def line_at(self, element: Any, path: str, place: str) -> FloatArray:
        """(K, 2) the line of the points at a path below an element [m]."""
        points = [
            [self.number(point.findtext(axis), "position", place) for axis in "xy"]
            for point in element.iterfind(f"{path}/point")
        ]
        line = self.line(points, place)
        if len(line) < 2:
            raise self.fault(f"{place} has no length")
        return line


def refs(element: Any, path: str) -> list[str]:
    """What the elements at a path refer to."""
    return [found.get("ref", "") for found in element.iterfind(path)]


def first_ref(element: Any, path: str) -> str | None:
    """What the first element at a path refers to, if there is one."""
    return next(iter(refs(element, path)), None)
