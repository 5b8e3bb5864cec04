"""Tables of what is compared with what: a TOML file beside the module that makes our side.

A section has a row for every value of a reference: its name there, and where ours is, as a path
among the names that the module hands over. A row with its own tolerance is a list; the row `"*"`
says what holds for the others, and how the report calls the section.

    [routes]                                        # a case of routes.json
    "*" = { called = "PDM", atol = 1e-9, optional = false }
    start_block = "blocks of route.start.block"     # ids in a layer of the map `road`, or `tracks`
    n_centerline = "number of line"
    centerline_last = ["line[-1, :2]", 1e-6]        # m
    poses = ["poses", [1e-3, 1e-3, 1e-4]]           # m, m, rad: of each column
    "ends[..., 2]" = ["line[-2:, 2]", 1e-6, "angle"]  # rad: of a part, equal up to whole turns
    score = ["score", { base = 1e-5, drive = 1e-4 }]  # by the name `variant`
    planner = "= PDM-Closed *"                      # a text, which may go on in any way
    samples = 41                                    # a number
"""

import re
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from shiftsim.verify.files import EXACT, Source, read_arrays, read_index, read_json
from shiftsim.verify.report import Report
from shiftsim.world.scenario import Scenario

Row: TypeAlias = Any  # a path, text or number; a path and a tolerance; rows by name


class Table:
    """One section: rows by the names of the reference."""

    def __init__(self, rows: Mapping[str, Row]) -> None:
        self.about = {"called": None, "atol": EXACT, "optional": False, **rows.get("*", {})}
        self.rows = {name: row for name, row in rows.items() if name != "*"}

    def match(self, theirs: Source, where: str, called: str = "", /, **names: Any) -> bool:
        """Compare ours with the values of all rows; whether all agree."""
        ours, bounds, angles = {}, {}, []
        for name, row in self.rows.items():
            if name in theirs or not self.about["optional"]:
                path, atol, *kind = row if isinstance(row, list) else (row, self.about["atol"])
                bounds[name] = atol[names["variant"]] if isinstance(atol, dict) else atol
                ours[name] = _find(path, names, theirs.values.get(name))
                angles += [name] if kind == ["angle"] else []
        called = called or self.about["called"]
        return theirs.match(where, ours, bounds, quantity=called, angles=angles)


def read_tables(*modules: str) -> dict[str, Table]:
    """The sections of the files beside modules, given by their paths; later ones add rows."""
    sections: dict[str, Any] = {}
    for module in modules:
        content = tomllib.loads(Path(module).with_suffix(".toml").read_text("utf-8"))
        sections = _joined(sections, content)
    return {name: Table(rows) for name, rows in sections.items()}


def _joined(rows: Mapping[str, Row], more: Mapping[str, Row]) -> dict[str, Row]:
    """Rows and further ones, also within a row that is rows by name."""
    inner = {
        name: _joined(rows[name], more[name])
        for name in more
        if isinstance(more[name], dict) and name in rows
    }
    return {**rows, **more, **inner}


def verify_cases(
    compare: Callable[..., None],
    path: Path,
    report: Report,
    scenes: Mapping[str, Scenario] | None = None,
) -> None:
    """`compare` every case of a file, also with its scene; cases of other scenes are not covered.

    Cases are the entries of a `.json`; arrays whose names begin with the same number, `3_name`; the
    rows of all arrays.
    """
    cases = _read_cases(path, report)
    for number, case in enumerate(cases):
        scene = case["scene"] if scenes is not None else ""
        if scenes is not None and scene not in scenes:
            report.skip(f"{path.name}: scene {scene}, which is not at hand")
            continue
        where = f"{path.stem} {number} {scene}".strip()
        with report.attempt(path.stem, where):
            compare(case, where, *([] if scenes is None else [scenes[scene]]))
        if case.rows is None or case is cases[-1]:  # rows share what was used
            case.finish()


def _read_cases(path: Path, report: Report) -> list[Source]:
    if path.suffix == ".json":
        return [Source(path.name, "field", case, report) for case in read_json(path)]
    file = read_arrays(path, report)
    if next(iter(file))[0].isdigit():
        numbers = sorted({int(name.split("_")[0]) for name in file})
        return [file.below(f"{number}_") for number in numbers]
    # a shorter array fails where it is read; one that nothing reads is named as such
    return [file.at(row) for row in range(max(map(len, file.values.values())))]


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
    value: Any = names
    for name, index in re.findall(r"(\w+)|\[(.*?)\]", path):
        if index:
            value = value[read_index(index)]
        else:
            value = value[name] if isinstance(value, Mapping) else getattr(value, name)
    if kind == "number":
        return len(value)
    if not kind:
        return value
    ids = names["tracks"].tokens if kind == "tracks" else getattr(names["road"], kind).ids
    return [ids[i] for i in value] if np.ndim(value) else ids[value]
