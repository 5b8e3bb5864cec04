"""Tables of what is compared with what: a TOML file beside the module that makes our side.

A section has a row for every value of a reference: its name there, and where ours is, as a path
among the names that the module hands over: through attributes, items and results of methods. A row
with its own tolerance is a list; the row `"*"` says what holds for the others, and how the report
calls the section; it may also name `angles` and `unordered` values (`Source.match`). The words of
rows stand in `tables.toml`, by example.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from inspect import isroutine
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from shiftsim.errors import DataError
from shiftsim.files import read_toml
from shiftsim.verify.files import EXACT, Scenes, Source, read_file, read_index
from shiftsim.verify.report import Report

Row: TypeAlias = Any  # a path, text or number; a path and a tolerance; rows by name


class Table:
    """One section: rows by the names of the reference."""

    def __init__(self, rows: Mapping[str, Row]) -> None:
        self.about = {"called": None, "atol": EXACT, "optional": False, **rows.get("*", {})}
        self.rows = {name: row for name, row in rows.items() if name != "*"}
        self._kinds = {kind: self.about.get(kind, ()) for kind in ("angles", "unordered")}

    def match(self, theirs: Source, where: str, called: str = "", /, **names: Any) -> bool:
        """Compare ours with the values of all rows; whether all agree."""
        ours, bounds = {}, {}
        for name, row in self.rows.items():
            if name in theirs or not self.about["optional"]:
                path, atol = row if isinstance(row, list) else (row, self.about["atol"])
                atol = names[atol] if isinstance(atol, str) else atol
                bounds[name] = atol[names["variant"]] if isinstance(atol, dict) else atol
                ours[name] = _find(path, names, theirs.values.get(name))
        called = called or self.about["called"]
        return theirs.match(where, ours, bounds, quantity=called, **self._kinds)


def read_tables(*modules: str) -> dict[str, Table]:
    """The sections of the files beside modules, given by their paths; later ones add rows."""
    sections: dict[str, Any] = {}
    for module in modules:
        sections = _joined(sections, read_toml(Path(module).with_suffix(".toml")))
    return {name: Table(rows) for name, rows in sections.items()}


def _joined(rows: Mapping[str, Row], more: Mapping[str, Row]) -> dict[str, Row]:
    """Rows and further ones, also within a row that is rows by name."""
    joined = {**rows, **more}
    for name in rows:
        if isinstance(more.get(name), dict):
            joined[name] = _joined(rows[name], more[name])
    return joined


def verify_cases(
    compare: Callable[..., None], path: Path, report: Report, scenes: Scenes | None = None
) -> None:
    """`compare` every case of a file, also with its scene; cases of other scenes are not covered.

    Cases are the entries of a `.json`; arrays whose names begin with the same number, `3_name`; the
    rows of all arrays.
    """
    file = read_file(path, report)
    if path.suffix == ".json":
        cases = [Source(path.name, "field", case, report) for case in file["rows"]]
    elif next(iter(file))[0].isdigit():
        numbers = sorted({int(name.split("_")[0]) for name in file})
        cases = [file.below(f"{number}_") for number in numbers]
    else:
        cases = rows_of(file)
    for number, case in enumerate(cases):
        scene = case["scene"] if scenes is not None else ""
        if scenes is not None and scene not in scenes.entries:
            report.skip(f"{path.name}: scene {scene}, which is not at hand")
            continue
        where = f"{path.stem} {number} {scene}".strip()
        with report.attempt(path.stem, where):
            compare(case, where, *([] if scenes is None else [scenes[scene]]))
        if case.rows is None or case is cases[-1]:  # rows share what was used
            case.finish()


def rows_of(file: Source) -> list[Source]:
    """The rows of all arrays as parts, as many as those have that nothing has used yet.

    `<prefix>_ptr` says which rows of the arrays `<prefix>_…` belong together: from a number in it
    to the next one. A `DataError` if these are not all rows.
    """
    arrays, counted = dict(file.values), file.values.keys() - file.used
    for ends in [name for name in arrays if name.endswith("_ptr")]:
        begins = file.take(ends, -1)
        for name in arrays:
            if name.startswith(ends.removesuffix("ptr")) and name != ends:
                size = len(arrays[name])
                if begins[0] or begins[-1] != size or (np.diff(begins) < 0).any():
                    where = f"which are not those of {len(begins) - 1} cases"
                    raise DataError(f"{file.name}: array {name!r} has {size} rows, {where}")
                arrays[name] = np.split(arrays[name], begins[1:-1])
        arrays[ends] = begins[:-1]
    # a shorter array fails where it is read; one that nothing reads is named as such
    count = max(len(arrays[name]) for name in counted)
    return [replace(file, values=arrays, rows=row) for row in range(count)]


def _find(row: Row, names: Mapping[str, Any], theirs: Any = None) -> Any:
    """What a row stands for; an open text is `theirs` if that begins like it."""
    if isinstance(row, dict):
        known = theirs if isinstance(theirs, dict) else {}
        return {name: _find(inner, names, known.get(name)) for name, inner in row.items()}
    if not isinstance(row, str):
        return row
    if row.startswith("= "):
        text = row[2:].format(**names)
        is_open = text.endswith("*") and isinstance(theirs, str)
        return theirs if is_open and theirs.startswith(text[:-1]) else text
    kind, _, path = row.rpartition(" of ")
    value = _follow(names, path)
    if kind == "number":
        return len(value)
    if kind == "text":
        return [",".join(words) for words in value]
    if kind == "ids":
        ids = [getattr(thing, "id", None) for thing in (value if np.iterable(value) else [value])]
        return ids if np.iterable(value) else ids[0]
    if not kind:
        return value
    known = names["tracks"].tokens if kind == "tracks" else getattr(names["road"], kind).ids
    return [known[i] for i in value] if np.ndim(value) else known[value]


def _follow(names: Mapping[str, Any], path: str) -> Any:
    """What a path leads to; behind `[*]` a list of what it leads to from every one."""
    found: list[Any] = [names]
    for name, index in re.findall(r"(\w+)|\[(.*?)\]", path):
        if index == "*":
            found = [inner for thing in found for inner in thing]
        elif index:
            key = names[index] if index in names else read_index(index)
            found = [thing[key] for thing in found]
        else:
            found = [_member(thing, name) for thing in found]
    return found if "[*]" in path else found[0]


def _member(thing: Any, name: str) -> Any:
    """An item of a mapping, an attribute, or what a method returns."""
    value = thing[name] if isinstance(thing, Mapping) else getattr(thing, name)
    return value() if isroutine(value) else value
