"""Tables in the layouts that people have: read as they are meant, or refused with what helps."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from shiftsim.cli import main
from shiftsim.data.readers.tracks.reader import TracksReader, convert_tracks
from shiftsim.errors import ConversionError
from shiftsim.files import read_toml

UTM = np.array([297133.4, 5623440.5])
NGSIM = (
    "Vehicle_ID Frame_ID Total_Frames Global_Time Local_X Local_Y Global_X Global_Y v_Length"
    " v_Width v_Class v_Vel v_Acc Lane_ID Preceding Following Space_Headway Time_Headway"
).split()
CAR, TRUCK = ([19.3408, 5.4637], (4.6, 1.9)), ([102.8758, 40.0544], (12.0, 2.5))
SCENE = {"1": CAR, "3": TRUCK}  # centre in the first row, size; of the same scene in all folders
LEADS = 0.05  # m, by which the way of the front of a truck leaves its heading: 6 m * 6 m / 800 m
WALKER = {"P1": ([262.1583, 145.9621], (0.7, 0.7))}


@dataclass
class Case:
    tables: str
    scenarios: int
    objects: dict = field(default_factory=lambda: SCENE)
    columns: str | dict | None = None  # a file of the folder, or what it would hold
    layout: str = ""
    notes: tuple[str, ...] = ()
    within: float = 0.01  # m


SUMO = {"veh1": CAR, "veh3": TRUCK}
HIGHD = {"1": ([10.0, -13.75], (4.6, 1.9))}
AT_ORIGIN = {"0": (CAR[0] + UTM, CAR[1]), "2": (TRUCK[0] + UTM, TRUCK[1])}
ASIDE = ("pedestrian_tracks_000.csv lies beside",)
CASES = {
    "b1": Case("b1_sumo_fcd/fcd.csv", 6, SUMO, layout="SUMO FCD"),
    "b1 with a file": Case("b1_sumo_fcd/fcd.csv", 6, SUMO, "sumo3.toml", "SUMO FCD"),
    "b1 without heading": Case(
        "b1_sumo_fcd/fcd.csv", 6, SUMO, {"columns": {"heading": ""}}, "SUMO FCD", within=LEADS
    ),
    "b2": Case("b2_ngsim_front/trajectories.csv", 6, layout="NGSIM", within=LEADS),
    "b2 with reference": Case(
        "b2_ngsim_front/trajectories.csv", 6, columns="ng4.toml", layout="NGSIM", within=LEADS
    ),
    "b2 without": Case(
        "b2_ngsim_front/trajectories.csv", 6, columns="ng5.toml", layout="NGSIM", within=LEADS
    ),
    "b3": Case("b3_highd_corner/01_tracks.csv", 4, HIGHD, layout="highD"),
    "b3 with a file": Case("b3_highd_corner/01_tracks.csv", 4, HIGHD, "highd.toml", "highD"),
    "b4 one table": Case("b4_interaction_merged/merged.csv", 7, SCENE | WALKER),
    "b4 two tables": Case(
        "b4_interaction_merged/vehicle_tracks_000.csv"
        " b4_interaction_merged/pedestrian_tracks_000.csv",
        7,
        SCENE | WALKER,
    ),
    "b4 vehicles": Case("b4_interaction_merged/vehicle_tracks_000.csv", 7, notes=ASIDE),
    "b4 decimal commas": Case("b4_interaction_merged/excel_de.csv", 7),
    "b5": Case("b5_levelx_utm/00_tracks.csv", 6, AT_ORIGIN, layout="levelXdata"),
    "b5 shifted by search": Case(
        "b5_levelx_utm/00_tracks.csv",
        6,
        {"0": (CAR[0] + np.array([297130.7, 5623438.5]), CAR[1])},
        "ind.toml",
        "levelXdata",
        ("found by search is approximate",),
    ),
    "b6 named": Case(
        "b6_headerless/trajectories-0750am-0805am.txt",
        6,
        columns={"header": NGSIM},
        layout="NGSIM",
        within=LEADS,
    ),
    "b7": Case("b7_songdo/A_2022.csv", 6, layout="Songdo"),
}
REFUSED = {
    "b4 several cases": ("b4_interaction_merged/val_case.csv", "'case_id' tells 2", "file of its"),
    "b6": (
        "b6_headerless/trajectories-0750am-0805am.txt",
        "the first line holds numbers: no header",
        r"name all 18 columns .* header = \['id'",
    ),
}


@pytest.fixture(scope="module")
def cases(shared):
    folder = shared / "reference/field_cases"
    if not folder.is_dir():
        pytest.skip("the folder reference/field_cases is absent")
    return folder


def _inspect(cases: Path, tables: str, columns=None):
    paths = [cases / name for name in tables.split()]
    (road,) = paths[0].parent.glob("*.xodr")
    overrides = read_toml(paths[0].parent / columns) if isinstance(columns, str) else columns
    return TracksReader(paths, road, overrides=overrides)


@pytest.mark.parametrize("name", CASES)
def test_a_table_is_read_as_it_is_meant(name, cases, tmp_path):
    case = CASES[name]
    found = _inspect(cases, case.tables, case.columns)
    assert not found.diagnostics.errors
    assert found.table.columns.layout == case.layout
    notes = [warning.what for warning in found.diagnostics.warnings]
    assert len(notes) == len(case.notes)
    assert all(part in note for part, note in zip(case.notes, notes, strict=True))
    samples = found.read(found.table.name).samples
    ids = [str(name) for name in samples.track_ids]
    for one, (center, size) in case.objects.items():
        number = ids.index(one)
        row = np.flatnonzero(samples.track == number)[0]
        np.testing.assert_allclose(samples.xy[row], center, rtol=0, atol=case.within)
        np.testing.assert_allclose(samples.sizes[number], size, rtol=0, atol=0.01)
    assert convert_tracks(found, tmp_path / "store").accepted == case.scenarios


@pytest.mark.parametrize("name", REFUSED)
def test_a_table_that_cannot_be_read_says_what_helps(name, cases):
    table, what, remedy = REFUSED[name]
    with pytest.raises(ConversionError, match=what) as error:
        _inspect(cases, table)
    assert re.search(remedy, error.value.hint)


def test_the_command_says_what_it_took_positions_for(cases, tmp_path, capsys):
    folder = cases / "b3_highd_corner"
    files = [str(folder / name) for name in ("01_tracks.csv", "map_straight.xodr")]
    with pytest.raises(SystemExit) as code:
        main(["convert", "tracks", *files, "--store", str(tmp_path / "store")])
    assert not code.value.code
    printed = capsys.readouterr().out
    assert " layout: highD\n point given: corner\n" in printed
    assert "y = -y, width = height" in printed


def test_the_remedy_of_a_shift_by_search_calls_it_approximate(cases):
    found = _inspect(cases, "b5_levelx_utm/00_tracks.csv", {"shift_m": [0.0, 0.0]})
    (error,) = found.diagnostics.errors
    assert "shift_m = [29713" in error.remedy
    assert "(approximate, found by search" in error.remedy
    assert "exact, the difference" in error.remedy


def test_all_columns_that_are_missing_are_named_at_once(cases, tmp_path):
    (tmp_path / "t.csv").write_text("a,x,b\nk,2.0,3\n")
    (road,) = (cases / "b7_songdo").glob("*.xodr")
    with pytest.raises(ConversionError) as error:
        TracksReader(tmp_path / "t.csv", road)
    assert "'id', 'y', 'kind' and neither a time nor a frame; it has a, x, b" in str(error.value)
    assert "id = 'NAME', y = 'NAME', kind = 'NAME', time = 'NAME'" in error.value.hint


def test_an_axis_that_is_turned_already_is_not_turned_twice(cases):
    """The remedy is the column as it must be written, not a second minus."""
    found = _inspect(cases, "b4_interaction_merged/merged.csv", {"columns": {"y": "-y"}})
    remedies = " ".join(error.remedy for error in found.diagnostics.errors)
    assert "y = 'y'" in remedies
