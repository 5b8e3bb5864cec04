import json
import re
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import shapely
from map_checks import check_map

from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.store.check import survey_store
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.writing import StoreWriter
from shiftsim.data.synthetic import recordings as town_recordings
from shiftsim.data.synthetic.agents import SIZES, arc_at
from shiftsim.data.synthetic.layouts import KINDS, random_town
from shiftsim.data.synthetic.population import random_traffic
from shiftsim.data.synthetic.store import FOREIGN, town_specs, write_towns
from shiftsim.data.synthetic.town import Lights, Town
from shiftsim.data.synthetic.traffic import DT
from shiftsim.errors import ConfigError, DataError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.runs.filter import FilterConfig, judge_scenario
from shiftsim.runs.workers import map_unordered
from shiftsim.world.state import LightStatus
from tests.commands import call

ONE_PROCESS = partial(map_unordered, workers=1)
DURATION = 42.08  # s


def _town(kind, number=0):
    rng = np.random.Generator(np.random.Philox(number))
    return random_town(kind, "test", rng), rng


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Two towns of seed 5: a junction, and one with traffic lights."""
    return write_towns(
        tmp_path_factory.mktemp("towns") / "two", towns=2, seed=5, spread=ONE_PROCESS
    )


def _files(store):
    return json.loads((store.path / "store.json").read_text())["files"]


# ---- the store


def test_foreign_kinds_are_kept_back_from_towns_at_home():
    home, foreign = (town_specs(8, 1, domain) for domain in ("home", "foreign"))
    assert {spec.kind for spec in foreign} == set(FOREIGN) < set(KINDS)
    assert {spec.kind for spec in home} == set(KINDS) - set(FOREIGN)
    assert set(home) < set(town_specs(12, 1))
    assert not {spec.name for spec in foreign} & {spec.name for spec in town_specs(40, 1)}


@pytest.mark.thorough
def test_a_crowd_is_of_pedestrians_and_cyclists():
    def count(crowd):
        traffics = []
        for number in range(10):
            town, rng = _town("junction", number)
            traffics.append(random_traffic(town, rng, DURATION, crowd=crowd))
        drivers = [driver.category for traffic in traffics for driver in traffic.drivers]
        return sum(len(x.pedestrians) for x in traffics), drivers.count("bicycle") / len(drivers)

    (few, rare), (many, frequent) = count(1.0), count(2.0)
    assert 1.5 < many / few < 2.6
    assert frequent / rare == pytest.approx(0.5 / 1.25 / 0.25, rel=0.25)


def test_an_unknown_domain_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="domain 'abroad' unknown"):
        write_towns(tmp_path / "x", towns=1, seed=1, domain="abroad", spread=ONE_PROCESS)


@pytest.mark.thorough
def test_a_store_says_what_generated_it(store):
    assert store.generator == {"name": "towns", "seed": 5, "towns": 2}
    assert store.cities == ("town-5-001", "town-5-002")
    assert [x for x in survey_store(store.path).problems if x.is_error] == []


def test_two_towns_give_many_scenarios_that_pass_the_filter(store):
    verdicts = [judge_scenario(scene, FilterConfig()) for scene in store]
    accepted = [row["token"] for row in verdicts if row["verdict"] == "accepted"]
    assert len(accepted) >= 10 * 2
    assert {row["reason"] for row in verdicts} <= {"", "path too short"}


def test_every_route_has_the_two_blocks_that_planners_need(store, tmp_path, monkeypatch):
    assert min(len(store.window(token).route) for token in store.tokens) >= 2
    monkeypatch.setattr(town_recordings, "_MIN_BLOCKS", 3)
    few = write_towns(tmp_path / "few", towns=1, seed=5, spread=ONE_PROCESS)
    here = [x for x in map(store.window, store.tokens) if x.log_name.startswith("town-5-001")]
    assert set(few.tokens) == {window.token for window in here if len(window.route) >= 3}
    assert 0 < len(few.tokens) < len(here)


def test_a_town_is_the_same_bytes_in_a_store_of_one(store, tmp_path):
    alone = write_towns(tmp_path / "one", towns=1, seed=5, spread=ONE_PROCESS)
    files = {name: x for name, x in _files(alone).items() if name != "scenarios.parquet"}
    assert len(files) > 5
    assert files.items() <= _files(store).items()
    assert set(alone.tokens) <= set(store.tokens)


@pytest.mark.thorough
def test_the_bytes_do_not_depend_on_the_number_of_workers(store, tmp_path):
    spread = partial(map_unordered, workers=2)
    again = write_towns(tmp_path / "again", towns=2, seed=5, spread=spread)
    assert (again.path / "store.json").read_bytes() == (store.path / "store.json").read_bytes()
    other = write_towns(tmp_path / "other", towns=1, seed=6, spread=ONE_PROCESS)
    assert not set(other.tokens) & set(store.tokens)
    assert not set(other.cities) & set(store.cities)


def test_a_store_that_is_there_is_kept_and_another_one_refused(store, tmp_path):
    before = (store.path / "store.json").stat().st_mtime_ns
    assert write_towns(store.path, towns=2, seed=5, spread=ONE_PROCESS).hash == store.hash
    assert (store.path / "store.json").stat().st_mtime_ns == before
    with pytest.raises(ConfigError, match="holds something else"):
        write_towns(store.path, towns=2, seed=6, spread=ONE_PROCESS)
    with pytest.raises(ConfigError, match="holds something else"):
        write_towns(tmp_path, towns=2, seed=5, spread=ONE_PROCESS)


def test_a_worker_that_dies_is_named_and_leaves_nothing(tmp_path):
    def dying(make, specs):
        yield type("Outcome", (), {"task": specs[0], "result": None, "death": "killed"})

    with pytest.raises(DataError, match="town 'town-5-001': killed"):
        write_towns(tmp_path / "store", towns=1, seed=5, spread=dying)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
def test_a_town_with_too_few_scenarios_is_drawn_again(tmp_path, monkeypatch):
    attempts = []

    def convert(source, store, spec, place):
        attempts.append((source / "map/map.xodr").read_text())
        store.mkdir()
        (store / "here").touch()
        return 0 if len(attempts) < 3 else 6

    monkeypatch.setattr(town_recordings, "_convert", convert)
    town_recordings.make_town(tmp_path, town_specs(1, 5)[0])
    assert len(set(attempts)) == 3
    assert (tmp_path / "town-5-001" / "here").is_file()


def test_what_is_added_to_a_generated_store_takes_the_mark_away(tmp_path):
    with StoreWriter(tmp_path / "store", {"name": "test"}):
        pass
    assert ScenarioStore(tmp_path / "store").generator == {"name": "test"}
    with StoreWriter(tmp_path / "store"):
        pass
    assert ScenarioStore(tmp_path / "store").generator == {}


def test_a_generator_that_is_no_table_is_an_error(tmp_path):
    with StoreWriter(tmp_path, {"name": "test"}):
        pass
    path = tmp_path / "store.json"
    path.write_text(path.read_text().replace('{\n  "name": "test"\n }', '"test"'))
    with pytest.raises(DataError, match="'generator' is no table"):
        ScenarioStore(tmp_path)


# ---- roads


@pytest.mark.parametrize("kind", KINDS)
def test_the_map_of_every_kind_passes_the_checks_of_the_reader(kind, tmp_path):
    town, _ = _town(kind)
    path = tmp_path / "map.xodr"
    path.write_text(town.xml())
    road, report = build_road_map(read_opendrive(path), name=kind)
    assert {name for name, good in check_map(road, report.stacked)[0].items() if not good} == set()
    assert report.warnings == {}
    lit = {road.edges.ids[k] for k in np.flatnonzero(road.has_traffic_lights)}
    assert bool(lit) == bool(town.lights)


def test_towns_differ_in_arms_lanes_and_limits():
    towns = [KINDS["lights"](np.random.Generator(np.random.Philox(x))) for x in range(24)]
    streets = [street for town in towns for street in town]
    assert {len(town) for town in towns} == {3, 4, 5}
    assert {street.lanes for street in streets} == {1, 2, 3}
    assert len({street.limit for street in streets}) >= 5


# ---- traffic


def _assert_apart(boxes, parked):
    """Nobody shares ground with anybody, but for pedestrians among themselves."""
    still = boxes_to_corners(parked, np.tile([4.5, 1.85], (len(parked), 1)))
    for frame in range(0, 500, 6):
        now = [box for box in boxes if box[0] == frame]
        sizes = np.array([SIZES[box[2]][:2] for box in now])
        corners = boxes_to_corners(np.array([box[3:6] for box in now]), sizes)
        shapes = shapely.polygons(np.concatenate([corners, still]))
        on_foot = [box[2] == "pedestrian" for box in now] + [False] * len(parked)
        for i, j in shapely.STRtree(shapes).query(shapes, predicate="intersects").T.tolist():
            both_on_foot = on_foot[i] and on_foot[j]
            assert i >= j or both_on_foot or i >= len(now), (frame, now[i], j)


@pytest.mark.parametrize(
    "kind",
    ["street", *(pytest.param(x, marks=pytest.mark.thorough) for x in KINDS if x != "street")],
)
def test_nobody_touches_anybody_and_traffic_drives_smoothly(kind):
    town, rng = _town(kind, 3)
    traffic = random_traffic(town, rng, DURATION)
    boxes = traffic.record(DURATION)
    _assert_apart(boxes, town.parked())
    rows = np.array([(x[0], x[1], *x[3:8]) for x in boxes if x[2] != "pedestrian"])
    rows = rows[np.lexsort((rows[:, 0], rows[:, 1]))]
    same = (np.diff(rows[:, 1]) == 0) & (np.diff(rows[:, 0]) == 1)
    assert np.abs(np.diff(rows[:, 5])[same] / DT).max() < 4.0
    steps = np.hypot(*np.diff(rows[:, 2:4], axis=0).T)[same]
    assert steps.max() < 22.0 * DT
    assert rows[:, 5].max() > 5.0


def test_some_people_step_out_between_parked_cars():
    found = {True: [], False: []}
    for number in range(6):
        town = _town("street", number)[0]
        for street in town.streets.values():
            for ends in street.crossings if street.parking else ():
                middle = street.road.at(np.array([sum(ends) / 2]))[0, :2]
                found[street.is_marked].append(np.hypot(*(town.parked()[:, :2] - middle).T).min())
    assert min(found[True]) > 11.0 > min(found[False])


def test_traffic_lights_are_in_the_store_for_the_connectors_that_have_one(store):
    scene = next(s for s in map(store.read, store.tokens) if s.city == "town-5-002")
    edges = scene.map.edges.ids
    lit = {edges[k] for k in np.flatnonzero(scene.map.has_traffic_lights)}
    assert set(scene.traffic_lights.connector_ids) == lit
    assert {0, 2} <= set(np.unique(scene.traffic_lights.status)) <= {0, 1, 2}


def test_streets_take_turns_and_yellow_lies_between_green_and_red():
    lights = Lights((frozenset({1}), frozenset({2})), (10.0, 8.0), 4.0, {"crosswalk": 1})
    lit = Town("test", lights=(lights,)).lit()
    times = np.arange(0.0, 60.0, 0.5).tolist()
    shown = [[lights.status(phase, time) for time in times] for phase in (0, 1)]
    assert all(LightStatus.RED in both for both in zip(*shown, strict=True))
    changes = {(a, b) for row in shown for a, b in pairwise(row) if a != b}
    green, yellow, red = LightStatus.GREEN, LightStatus.YELLOW, LightStatus.RED
    assert changes == {(green, yellow), (yellow, red), (red, green)}
    assert shown[0].index(yellow) == 12  # 6 s: 4 s of the 10 are over
    for time, (one, two) in zip(times, zip(*shown, strict=True), strict=True):
        closed = {n for n, (x, phase) in lit.items() if x.status(phase, time) != green}
        assert closed == {n for n, x in ((1, one), (2, two)) if x != green}
        assert (lights.wait(lights.crossings["crosswalk"], time) > 0.0) == (two == red)


@pytest.mark.parametrize("number", [0, pytest.param(4, marks=pytest.mark.thorough)])
def test_nobody_enters_a_junction_at_red(number):
    town, rng = _town("lights", number)
    traffic = random_traffic(town, rng, DURATION)
    (lights,) = town.lights
    phases = {road: k for k, group in enumerate(lights.phases) for road in group}
    entered = 0
    for driver in traffic.drivers:
        zone = driver.path.zones[0]
        rows = [x for x in traffic.record(DURATION) if x[1] == driver.track]
        front = [arc_at(driver.path.points, np.array(x[3:5])) + driver.length / 2 for x in rows]
        late = [x[0] * DT for x, s in zip(rows, front, strict=True) if s > zone.stop + 2.5]
        if rows and front[0] < zone.stop and late:
            entered += 1
            shown = lights.status(phases[zone.id], late[0])
            assert shown in (LightStatus.GREEN, LightStatus.YELLOW), driver.track
    assert entered >= 5


# ---- the command


@pytest.mark.thorough
def test_the_command_makes_converts_and_filters(tmp_path):
    done = call(tmp_path, "demo", "--towns", "1", "--seed", "5", "--out", "mine", "--workers", "1")
    assert done.returncode == 0, done.stderr
    assert "1 town of seed 5" in done.stdout
    assert "scenarios accepted → mine" in done.stdout
    assert (tmp_path / "mine" / "filter" / "verdicts.parquet").is_file()
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--seed", "1"), "--seed is of random towns only"),
        (("--domain", "home"), "--domain is of random towns only"),
        (("--towns", "1", "--limit", "2"), "--limit is of runs, --towns runs nothing"),
        (("--towns", "0"), r"'--towns'.*(greater than or equal to 1|x>=1)"),  # as typer says it
    ],
)
def test_options_that_do_not_go_together_are_refused(tmp_path, words, told):
    done = call(tmp_path, "demo", *words)
    assert done.returncode == 1
    assert re.search(told, done.stderr)
    assert list(tmp_path.iterdir()) == []
