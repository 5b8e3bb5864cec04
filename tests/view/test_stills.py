"""Stills, grids and films: what is marked, what is said, and that it can be read."""

import shutil
from dataclasses import replace
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
from pictures import cut_off, overlaps, sizes_in_pdf, smallest, written
from worlds import cruise_scenario, standing_tracks, straight_road

from shiftsim.errors import ConfigError
from shiftsim.planners.registry import load_planner
from shiftsim.report.palette import ALARM, RECORDED, FigureFormat, planner_styles
from shiftsim.sim.loop import simulate
from shiftsim.view.drawing import caption, save_tracks_picture
from shiftsim.view.scene import ShownRollout
from shiftsim.view.still import map_picture, picture, save_figure
from shiftsim.world.state import AgentKind

pytest.importorskip("matplotlib")
COLLISION = {
    "metric": "no_ego_at_fault_collisions",
    "score": 0.0,
    "unit": "count",
    "threshold": 0.0,
    "first_violation_s": 2.0,
    "first_violation_value": 3.14,
}
SAID = "at-fault collision, pedestrian agent-1, Δv 3.1 m/s"
IN_FULL = "at-fault collision (NCR), pedestrian agent-1, Δv 3.1 m/s at 2.0 s"


@pytest.fixture(scope="module")
def scenario():
    bare = cruise_scenario(iterations=41)
    poses = np.array([[40.0, 3.5, 0.1], [25.0, -4.0, 1.0]])
    kinds = [AgentKind.VEHICLE, AgentKind.PEDESTRIAN]
    return replace(bare, tracks=standing_tracks(len(bare.time_us), poses, kinds))


@pytest.fixture(scope="module")
def shown(scenario):
    """Three planners, clean and disturbed; every second one hits a pedestrian."""
    hit = [{**COLLISION, "partner_token": scenario.tracks.tokens[1]}]
    out = []
    for planner in ("constant-velocity", "log-future", "idm"):
        for noise in ("none", "ou-high"):
            log = simulate(scenario, load_planner("constant-velocity"), noise=noise)
            metrics = hit if noise != "none" else []
            out.append(ShownRollout(planner, noise, 0, log, 0.0 if metrics else 0.87, metrics))
    return out


def said(scenario, text):
    return text.replace("agent-1", scenario.tracks.tokens[1])


def test_a_still_says_planner_noise_score_and_metric_in_words(scenario, shown):
    words = " ".join(text for text, _ in written(picture(scenario, shown, at=[1.0])))
    plain = " ".join(words.split())
    assert "idm: score 87" in plain
    assert said(scenario, f"idm, ou-high, seed 0: score 0; {IN_FULL}") in plain
    assert plain.count(said(scenario, SAID)) == 3


def test_a_still_of_several_seeds_names_them(scenario, shown):
    noisy = [one for one in shown if one.noise != "none"][:1]
    several = [*noisy, replace(noisy[0], seed=2)]
    words = " ".join(
        " ".join(text for text, _ in written(picture(scenario, several, at=[1.0]))).split()
    )
    assert f"{noisy[0].planner}, ou-high, seed 0:" in words
    assert f"{noisy[0].planner}, ou-high, seed 2:" in words


def test_no_words_of_a_picture_cover_others_or_are_cut_off(scenario, shown):
    for figure in (
        picture(scenario, shown, at=[1.0]),
        picture(scenario, shown[:1], at=[0.0]),
        picture(scenario, [replace(shown[1], planner="my_package.my_module:MyPlanner")], at=[0.0]),
        picture(scenario, shown[:2], at=[0.0, 1.0, 2.0]),
        picture(scenario),
        map_picture(scenario.map),
    ):
        assert overlaps(figure) == []
        assert cut_off(figure) == []


def test_the_scene_fills_most_of_a_still(scenario, shown):
    figure = picture(scenario, shown[:2], at=[1.0])
    figure.draw_without_rendering()
    (axes,) = figure.axes
    frame = axes.get_window_extent()
    assert frame.width * frame.height > 0.6 * figure.bbox.width * figure.bbox.height


def test_noise_and_the_recorded_driver_look_the_same_in_every_picture(scenario, shown):
    colour = planner_styles(item.planner for item in shown)["idm"].colour
    for figure in (picture(scenario, shown, at=[1.0]), picture(scenario, shown, at=[1.0, 2.0])):
        lines = [line for axes in figure.axes for line in axes.lines]
        mine = {
            (x.get_linestyle(), x.get_markerfacecolor()) for x in lines if x.get_color() == colour
        }
        assert mine == {("-", colour), ("--", "white")}
        dotted = {line.get_color() for line in lines if line.get_linestyle() == ":"}
        assert dotted == {RECORDED}


def test_the_ego_under_noise_is_hollow(scenario, shown):
    from matplotlib.colors import to_hex

    colour = planner_styles(["idm"])["idm"].colour
    faces = []
    for item in shown[-2:]:
        (axes,) = picture(scenario, [item], at=[1.0]).axes
        faces.append({to_hex(box.get_facecolor()[0]) for box in axes.collections[1:]})
    assert colour in faces[0]
    assert colour not in faces[1]
    assert "#ffffff" in faces[1]


def test_a_film_marks_a_violation_from_its_first_moment_on(scenario, shown, tmp_path, monkeypatch):
    from matplotlib.animation import PillowWriter

    seen = []

    def look(writer, **settings):
        (axes,) = writer.fig.axes
        crosses = [line for line in axes.lines if line.get_color() == ALARM]
        words = [text for text in axes.texts if text.get_text() == said(scenario, SAID)]
        seen.append([artist.get_visible() for artist in (*crosses, *words)])
        assert overlaps(writer.fig) == []

    monkeypatch.setattr(PillowWriter, "grab_frame", look)
    monkeypatch.setattr(PillowWriter, "finish", lambda writer: None)
    save_figure(tmp_path / "film.gif", scenario, shown)
    assert seen == [[False] * 6] * 20 + [[True] * 6] * (len(shown[0].log.time_us) - 20)


@pytest.mark.skipif(
    not (shutil.which("ffmpeg") or find_spec("imageio_ffmpeg")), reason="NOT COVERED: no ffmpeg"
)
def test_an_mp4_is_a_film_that_players_know(scenario, shown, tmp_path):
    save_figure(tmp_path / "film.mp4", scenario, shown[:1])
    content = (tmp_path / "film.mp4").read_bytes()
    assert content[4:8] == b"ftyp"
    assert b"avc1" in content  # H.264


def test_words_do_not_cover_those_of_the_scale(scenario):
    log = simulate(scenario, load_planner("constant-velocity"))
    hit = {**COLLISION, "partner_token": scenario.tracks.tokens[1]}
    several = [
        ShownRollout(name, "none", 0, log, 0.0, [{**hit, "first_violation_s": 0.1 * number}])
        for number, name in enumerate(("idm", "log-future", "plantf", "pluto", "carl", "simple"))
    ]
    assert overlaps(picture(scenario, several, at=[1.0])) == []


def test_the_picture_of_tracks_says_where_it_draws_one_row_in_several(tmp_path, monkeypatch):
    monkeypatch.setattr("shiftsim.view.drawing._MAX_POINTS", 100)
    xy = np.stack([np.linspace(0.0, 80.0, 600), np.zeros(600)], axis=1)
    table = SimpleNamespace(name="rec", xy=xy, track=np.zeros(600, int), track_ids=["a"])
    table.category, table.categories = np.zeros(600, int), ["car"]
    said = SimpleNamespace(errors=[], warnings=[])
    inspection = SimpleNamespace(road=straight_road(), table=table, diagnostics=said)

    save_tracks_picture(tmp_path / "a.svg", inspection, None)

    words = "1 objects, of their 600 rows one in 6 drawn"
    assert words in (tmp_path / "a.svg").read_text("utf-8")


def test_in_a_grid_words_stand_for_abbreviations_and_a_line_explains_marks(scenario, shown):
    words = [text for text, _ in written(picture(scenario, shown[:2], at=[0.0, 1.0, 2.0]))]
    assert words.count("at-fault collision") == 1  # from its moment on
    assert "NCR" not in words
    assert any("dotted: the recorded path" in text for text in words)


@pytest.mark.parametrize("width", ["3.5in", "7in", "89mm"])
@pytest.mark.parametrize("at", [[1.0], [0.0, 1.0, 3.0]])
@pytest.mark.thorough
def test_a_picture_of_a_paper_has_its_width_and_letters_that_can_be_read(
    scenario, shown, tmp_path, width, at
):
    form = FigureFormat.of(width, serif=True, plain=True)

    save_figure(tmp_path / "a.pdf", scenario, shown[:4], at=at, form=form)
    drawn = picture(scenario, shown[:4], at=at, form=form)

    sizes, found = sizes_in_pdf(tmp_path / "a.pdf")
    assert found == pytest.approx(form.width, abs=0.01)
    assert min(sizes) >= 7.0
    assert smallest(drawn) >= 7.0
    assert b"STIXGeneral" in (tmp_path / "a.pdf").read_bytes()
    assert overlaps(drawn) == []
    assert cut_off(drawn) == []


def test_a_plain_picture_has_neither_title_nor_notes(scenario, shown):
    for at in ([1.0], [0.0, 3.0]):
        full = [
            text
            for text, _ in written(
                picture(scenario, shown[:2], at=at, form=FigureFormat(note="so"))
            )
        ]
        plain = [
            text
            for text, _ in written(
                picture(scenario, shown[:2], at=at, form=FigureFormat(plain=True, note="so"))
            )
        ]
        assert any(scenario.token in text for text in full)
        assert not any(scenario.token in text for text in plain)
        assert "so" not in " ".join(plain).split()


def test_a_grid_of_four_planners_fits_a_page(scenario, shown):
    width, height = picture(scenario, shown[:4], at=[0.0, 2.0, 3.0]).get_size_inches()
    assert width == 7.0
    assert height <= 9.0


def test_a_grid_shows_what_is_around_an_ego_that_drives_to_the_right(scenario, shown):
    times = [0.0, 2.0, 3.0]
    for axes, time in zip(picture(scenario, shown[:1], at=times).axes, times, strict=True):
        assert axes.get_xlim() == (-25.0, 25.0)
        path = next(line for line in axes.lines if line.get_linestyle() == "-")
        assert path.get_xydata()[-1] == pytest.approx([0.0, 0.0], abs=1e-6)
        assert (path.get_xdata() <= 1e-6).all()
        assert len(path.get_xdata()) == round(time * 10) + 1


def test_a_film_follows_the_ego_and_its_path_grows(scenario, shown, tmp_path, monkeypatch):
    from matplotlib.animation import PillowWriter

    seen, steps = [], []

    def look(writer, **settings):
        (axes,) = writer.fig.axes
        path = next(x for x in axes.lines if x.get_linestyle() == "-")
        seen.append((len(path.get_xdata()), np.mean(axes.get_xlim()) - path.get_xdata()[-1]))

    monkeypatch.setattr(PillowWriter, "grab_frame", look)
    monkeypatch.setattr(PillowWriter, "finish", lambda writer: steps.append(writer.fps))
    reports = []
    save_figure(
        tmp_path / "a.gif",
        scenario,
        shown[:1],
        speed=4.0,
        on_progress=lambda done, total: reports.append((done, total)),
    )
    lengths, away = zip(*seen, strict=True)
    assert lengths == tuple(range(1, 41, 2))  # every other sample
    assert steps == [20.0]  # of them per second: four times as fast
    assert np.abs(away).max() < 1e-6
    assert reports[-1] == (40, 40)


@pytest.mark.parametrize(("width", "inches"), [("3.5in", 3.5), (7, 7.0), ("253pt", 3.5007)])
def test_a_width_is_a_length(width, inches):
    assert FigureFormat.of(width).width == pytest.approx(inches, abs=1e-3)


@pytest.mark.parametrize("width", ["wide", "3.5 miles", "0.1in", "99in", "1.2.3in", 0])
def test_what_is_no_width_is_refused(width):
    with pytest.raises(ConfigError, match="no width") as caught:
        FigureFormat.of(width)
    assert "3.5in" in caught.value.hint


def test_a_speed_that_is_none_is_refused(scenario, shown, tmp_path):
    with pytest.raises(ConfigError, match="speed"):
        save_figure(tmp_path / "a.gif", scenario, shown[:1], speed=0.0)


def test_a_caption_names_what_cost_most_though_it_has_no_moment(shown):
    rows = [
        {"metric": "ego_is_making_progress", "score": 0.0, "first_violation_s": None},
        {"metric": "ego_is_comfortable", "score": 0.0, "first_violation_s": 1.0},
    ]
    plain = {"first_violation_value": None, "unit": "boolean", "partner_token": None}
    item = replace(shown[0], noise="none", cls=0.0, metrics=[row | plain for row in rows])
    assert caption(item) == f"{item.planner}: score 0; no progress (EMP)"
