"""The page of input ranges says what the tables say."""

from itertools import groupby

from places import REPOSITORY

from shiftsim.world.ranges import FORMATS

PAGE = REPOSITORY / "docs/input_ranges.md"


def table_lines(name: str) -> list[str]:
    """A table of the page; fields of one range that follow each other share a line."""
    lines = [f"## {name}", "", "| field | lowest | highest | unit |", "|---|---|---|---|"]
    for allowed, items in groupby(FORMATS[name].items(), key=lambda item: item[1]):
        fields = ", ".join(f"`{field}`" for field, _ in items)
        lines.append(f"| {fields} | {allowed.low:g} | {allowed.high:g} | {allowed.unit} |")
    return lines


def test_the_page_has_every_range() -> None:
    lines = PAGE.read_text("utf-8").splitlines()
    for name in FORMATS:
        wanted = table_lines(name)
        start = lines.index(wanted[0])
        assert lines[start : start + len(wanted)] == wanted, "\n".join(wanted)
