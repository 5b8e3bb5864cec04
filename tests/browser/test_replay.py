import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from pages import sections, unpack
from stores import write_toy_store
from worlds import cruise_scenario, standing_tracks

import shiftsim
from shiftsim.data.store.reading import open_store
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import simulate
from shiftsim.view.build import Gallery, page_name, write_site
from shiftsim.view.page import Page, replay_page
from shiftsim.view.scene import ShownRollout
from shiftsim.world.state import AgentKind

SIZES = [(1440, 900), (800, 600)]
HOSTILE = (
    "<img src=x onerror=\"document.title='owned'\"></script><script>document.title='owned'</script>"
)
MARKS = """(() => {
  const spans = [], pen = strips.picture.getContext("2d"), fill = pen.fillText.bind(pen);
  pen.fillText = (text, x, y) => {
    spans.push([x, x + pen.measureText(text).width]);
    fill(text, x, y);
  };
  const mark = (t) => ({ t, row: 0, text: "TTC NCR", colour: "#000000", marker: "o" });
  strips.marks = [0, 0.1, 0.2, 5].map(mark);
  strips.paintMarks(pen, 100);
  return spans;
})()"""  # from where to where the words of four marks go
VIOLATED = "0001cafe"  # its ego meets a parked car


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Replays of a short run, and their list."""
    out = tmp_path_factory.mktemp("view")
    store = write_toy_store(out / "store", count=2, iterations=100)
    run = shiftsim.run(
        ["constant-velocity", "log-future"],
        noise=["none", "ou-high"],
        store=str(store),
        workers=1,
        out=str(out / "run"),
    )
    write_site(out, [Gallery([run], open_store(store))], title="toy")
    return out


@pytest.fixture
def replay(page, folder):
    """The replay of a scenario with a violation."""
    page.open(address(folder))
    return page


def address(folder, token=VIOLATED):
    return (folder / "replay" / page_name(token)).as_uri()


def now(page):
    return page.run("replay.state.t")


@pytest.mark.parametrize("size", SIZES)
def test_a_replay_loads_without_complaints_and_fits_the_window(page, folder, size, tmp_path):
    page.open(address(folder), size)

    assert VIOLATED in page.text("token")
    assert page.run("document.documentElement.scrollWidth") <= size[0]
    assert page.run("document.documentElement.scrollHeight") <= size[1]
    assert page.run("document.getElementById('scene').clientHeight") >= 0.4 * size[1]
    page.shoot(tmp_path / "replay.png")


def test_play_advances_and_pause_stays(replay):
    before = replay.pixels()

    replay.press(" ")
    replay.wait("replay.state.t > 0.3")
    replay.press(" ")
    stopped = now(replay)

    assert replay.pixels() != before
    assert not replay.run("replay.state.playing")
    assert now(replay) == stopped


def test_the_page_opens_with_the_whole_path_and_what_was_run(replay):
    ends = replay.run(
        "[0, times.length - 1].map((row) =>"
        " panels[0].panel.toScreen(...egoPose(0, {row, next: row, share: 0})))"
    )
    width, height = replay.run("[canvas.clientWidth, canvas.clientHeight]")

    assert all(15 < x < width - 15 and 15 < y < height - 15 for x, y in ends)
    assert replay.text("settings").startswith("traffic nonreactive · controller lqr · thresholds")


@pytest.mark.parametrize("size", [*SIZES, (390, 844)])
def test_the_scrubber_stands_below_its_time_on_the_curves(page, folder, size):
    page.open(address(folder), size)
    for share in (0.0, 0.5, 1.0):
        page.run(f"replay.seek({share} * duration())")
        left, width = page.run(
            "(({left, width}) => [left, width])(byId('time').getBoundingClientRect())"
        )
        thumb = left + 8 + share * (width - 16)
        assert thumb == pytest.approx(page.run("strips.x(replay.state.t)"), abs=1.0)


def test_a_phone_shows_the_scene_as_wide_as_it_is(page, folder):
    page.open(address(folder), (390, 844))

    assert page.run("document.documentElement.scrollWidth") <= 390
    assert page.run("canvas.clientWidth") >= 370  # beside a scroll bar
    assert page.run("canvas.clientHeight") >= 0.45 * 844
    tops = page.run(
        "['stage', 'controls', 'curves', 'rollouts']"
        ".map((id) => byId(id).getBoundingClientRect().top)"
    )
    assert tops == sorted(tops)


def test_a_violation_is_said_and_the_time_is_a_text(replay):
    replay.press("v")

    first = replay.run("meta.rollouts[state.focus].violations.find((v) => v.t === state.t)")
    assert replay.text("said").endswith(first["words"])
    assert replay.run("byId('time').getAttribute('aria-valuetext')") == f"{first['t']:.1f} seconds"


def test_play_ends_at_the_end(replay):
    replay.run("replay.seek(9.6)")
    replay.click("play")
    replay.wait("!replay.state.playing")

    assert replay.text("clock").startswith("9.80 s of 9.8 s")


def test_scrubbing_and_steps_move_in_time(replay):
    from selenium.webdriver.common.keys import Keys

    replay.browser.execute_script(
        "const time = document.getElementById('time'); time.value = 1.5;"
        "time.dispatchEvent(new Event('input'))"
    )
    assert now(replay) == pytest.approx(1.5)

    replay.press(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_LEFT)
    assert now(replay) == pytest.approx(1.6, abs=1e-3)

    replay.press(Keys.END)
    assert now(replay) == pytest.approx(9.8, abs=1e-3)
    replay.press(Keys.HOME)
    assert now(replay) == 0


def test_dragging_on_the_curves_scrubs(replay):
    replay.browser.execute_script(
        """const canvas = document.getElementById("curves");
        canvas.setPointerCapture = () => {};
        const box = canvas.getBoundingClientRect();
        const at = {clientX: box.left + 46 + (box.width - 56) / 2, clientY: box.top + 10};
        canvas.dispatchEvent(new PointerEvent("pointerdown", {...at, bubbles: true}));"""
    )

    assert now(replay) == pytest.approx(4.9, abs=0.05)


def test_rollouts_are_shown_and_hidden(replay):
    everything = replay.pixels()

    replay.press("1", "2")
    assert replay.run("replay.state.shown") == [False, False, True, True]
    assert replay.pixels() != everything

    replay.press("1", "2")
    assert replay.run("replay.state.shown") == [True] * 4


def test_the_last_rollout_cannot_be_hidden(replay):
    replay.press("1", "2", "3", "4")

    assert sum(replay.run("replay.state.shown")) == 1


def test_rollouts_stand_side_by_side(replay):
    together = replay.pixels()

    replay.click("side")

    assert replay.run("replay.state.side")
    assert replay.pixels() != together


def test_the_next_violation_is_jumped_to_and_its_partner_marked(replay):
    first = replay.run("Math.min(...meta.rollouts.flatMap((r) => r.violations.map((v) => v.t)))")

    replay.press("v")

    assert now(replay) == pytest.approx(first)
    times = replay.run("[...violations()].map((v) => v.t)")
    replay.press("v")
    later = [t for t in times if t > first]
    assert now(replay) == pytest.approx(later[0] if later else first)


def test_a_violation_is_told_in_words_near_and_with_its_partner(replay):
    assert replay.run("state.told") == []
    replay.run("zoom(0.2, 300, 200)")

    partner = replay.run("violations().find((v) => v.partner)")
    replay.run("jumpTo(violations().find((v) => v.partner))")

    assert partner["words"] in replay.run("state.told")
    assert f"vehicle {partner['partner']}" in partner["words"]
    assert replay.run("state.scale") >= 14
    assert replay.run("tracksOf(state.focus).names[highlighted]") == partner["partner"]


def test_a_link_to_a_violation_marks_its_partner(page, folder):
    page.open(address(folder))
    first = page.run("violations().find((v) => v.partner)")
    page.open(f"{address(folder)}#t={first['t']:.2f}&focus={first['index'] + 1}")

    page.wait("document.documentElement.dataset.ready")
    assert page.run("tracksOf(state.focus).names[highlighted]") == first["partner"]
    assert page.run("state.scale") >= 14
    page.open(f"{address(folder)}#t={first['t']:.2f}&focus={first['index'] + 1}&zoom=3.00")
    assert page.run("state.scale") == 3


# boxes of words and of marks that are drawn on the canvas: [left, top, right, bottom]
DRAWN = """(() => {
  const words = [], marks = [], strokeRect = context.strokeRect, mark = drawMarker;
  context.strokeRect = (x, y, w, h) => words.push([x, y, x + w, y + h]);
  window.drawMarker = (_, name, x, y) =>
    name === "burst" && marks.push([x - 6, y - 6, x + 6, y + 6]);
  draw();
  context.strokeRect = strokeRect;
  window.drawMarker = mark;
  return [words, marks, [canvas.clientWidth, canvas.clientHeight]];
})()"""


def meet(a, b):
    """Whether two boxes share a point."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


@pytest.mark.parametrize("size", SIZES)
def test_words_of_violations_lie_within_the_canvas_and_on_nothing_that_matters(page, folder, size):
    page.open(address(folder), size)
    for violation in page.run("violations()"):
        page.run(f"jumpTo({json.dumps(violation)})")
        words, marks, (width, height) = page.run(DRAWN)
        assert len(words) == 1 <= len(marks)  # those of the rollout in focus
        assert len(marks) == page.run("state.pins.length")
        assert all(0 <= w[0] and 0 <= w[1] and w[2] <= width and w[3] <= height for w in words)
        assert not any(meet(words[0], mark) for mark in marks)


def test_marks_on_the_timeline_say_their_words_on_hover(replay):
    mark = replay.run("strips.marks[0]")
    place = replay.run("[strips.x(strips.marks[0].t), strips.curves.length * STRIP_HEIGHT + 8]")

    assert mark["words"] == replay.run(f"strips.wordsAt({place[0]}, {place[1]})")
    assert len(mark["words"]) > len(mark["text"])
    assert replay.run("strips.wordsAt(1, 1)") == ""


def test_abbreviations_are_explained_and_the_keys_are_listed(replay):
    titles = replay.run("[...document.querySelectorAll('abbr')].map((a) => a.title)")
    assert "at-fault collision" in titles
    assert not replay.run("document.getElementById('keys').open")
    replay.press("?")
    assert replay.run("document.getElementById('keys').open")
    middle = replay.run(
        "document.elementFromPoint(innerWidth / 2, innerHeight / 2).closest('#keys')"
    )
    assert middle is not None  # over everything else
    replay.press("?")
    assert not replay.run("document.getElementById('keys').open")


def test_words_of_marks_never_lie_on_each_other(page, folder):
    page.open(address(folder), (800, 600))
    spans = sorted(page.run(MARKS))
    assert len(spans) >= 2
    assert all(a[1] <= b[0] for a, b in pairwise(spans))
    marks = page.run("strips.marks.map((mark) => strips.x(mark.t))")
    assert all(x + 4 <= left or x - 4 >= right for x in marks for left, right in spans)


def test_a_violation_button_jumps_to_its_rollout(replay):
    button = replay.browser.find_elements("css selector", ".rollout button")[-1]
    seconds = float(button.text.split()[0])

    button.click()

    assert now(replay) == pytest.approx(seconds, abs=0.051)
    assert replay.run("meta.rollouts[replay.state.focus].violations.length") > 0


def test_reloading_keeps_what_was_shown(replay):
    replay.press("2", "b", "f")
    replay.run("replay.seek(1.2)")
    replay.run("setFocus(2)")
    replay.run("zoom(1.5, 300, 200)")
    kept = replay.run("JSON.stringify([location.hash, replay.state])")

    replay.browser.refresh()
    replay.wait("document.documentElement.dataset.ready")

    assert replay.run("JSON.stringify([location.hash, replay.state])") == kept


def test_the_link_carries_the_time(page, folder):
    page.open(f"{address(folder)}#t=1.70&on=3&focus=3")

    assert now(page) == pytest.approx(1.7)
    assert page.run("replay.state.shown") == [False, False, True, False]


@pytest.mark.parametrize("hash", ["#t=abc&on=9&focus=-1&zoom=1e9", "#%%%", "#at=1,x&t=-5"])
def test_a_broken_link_shows_the_beginning(page, folder, hash):
    page.open(address(folder) + hash)

    assert now(page) == 0
    assert any(page.run("replay.state.shown"))


def test_zoom_and_drag_change_the_view(replay):
    before = replay.pixels()
    replay.press("+")
    zoomed = replay.pixels()
    replay.browser.execute_script(
        """const canvas = document.getElementById("scene");
        const fire = (target, kind, x) => target.dispatchEvent(
          new PointerEvent(kind, {clientX: x, clientY: 200, bubbles: true, pointerId: 1}));
        fire(canvas, "pointerdown", 300); fire(window, "pointermove", 420);
        fire(window, "pointerup", 420);"""
    )

    assert before != zoomed
    assert replay.pixels() != zoomed
    assert not replay.run("replay.state.follow")


def test_whole_plans_appear_at_the_moment_chosen(replay):
    assert replay.run("(replay.seek(1.0), planned)") == 0
    replay.wait("planned === 1")
    whole = replay.pixels()

    replay.press("p")
    without = replay.pixels()
    replay.browser.execute_script("replay.state.plans = true; planned = 0; replay.draw()")

    assert len({whole, without, replay.pixels()}) == 3


def test_while_it_plays_plans_end_with_their_first_second(replay):
    replay.wait("planned === 1")

    replay.press(" ")
    replay.wait("replay.state.t > 0.3")

    assert replay.run("replay.state.playing && planned") == 0


def test_hostile_texts_stay_texts(page, tmp_path):
    scenario = replace(
        cruise_scenario(iterations=11), token=HOSTILE, city=HOSTILE, scenario_type=HOSTILE
    )
    tracks = standing_tracks(len(scenario.time_us), [[20.0, 0.0, 0.0]], [AgentKind.VEHICLE])
    scenario = replace(scenario, tracks=replace(tracks, tokens=(HOSTILE,)))
    log = simulate(scenario, load_planner("constant-velocity"))
    row = {
        "metric": "no_ego_at_fault_collisions",
        "first_violation_s": 0.3,
        "first_violation_value": 1.0,
        "threshold": 0.0,
        "unit": HOSTILE,
        "partner_token": HOSTILE,
        "score": 0.0,
    }
    file = tmp_path / "hostile.html"
    file.write_text(
        replay_page(scenario, [ShownRollout(HOSTILE, HOSTILE, 0, log, 0.0, [row])]), "utf-8"
    )

    page.open(file.as_uri())
    page.press("v")

    assert HOSTILE in page.text("token")
    assert page.run("document.title") != "owned"
    assert page.run("document.images.length") == 0


def test_each_rollout_is_read_as_it_was_packed_also_where_it_is_stored_from_the_first(
    page, tmp_path
):
    bare = cruise_scenario()
    cars = standing_tracks(len(bare.time_us), [[30.0, 0.0, 0.0], [0.0, 4.0, 1.0]], [1, 0])
    scene = replace(bare, tracks=replace(cars, velocities=cars.velocities + 2.0))
    names = ("constant-velocity", "idm", "idm")
    logs = [simulate(scene, load_planner(name), traffic="reactive") for name in names]
    logs[2].plans[5:, 3:] = np.nan
    text = replay_page(
        scene, [ShownRollout(n, "none", 0, one) for n, one in zip(names, logs, strict=True)]
    )
    file = tmp_path / "page.html"
    file.write_text(text, "utf-8")
    page.open(file.as_uri() + "#on=3")
    parts = sections(text)
    for index, section in enumerate(("rollout0", "rollout2", "scene")):
        held = ("rollouts[0]", "rollouts[2]", "scene")[index]
        for name, values in unpack(parts[section], parts["rollout0"]).items():
            data = page.run(f"[...{held}.get({name!r}).data]")
            expected = np.ravel(values).astype(np.float32)
            np.testing.assert_array_equal(np.array(data, float), expected, name)
    assert page.run("rollouts[1]") is None  # nothing of it was asked for
    with pytest.raises(TypeError):
        unpack(parts["rollout2"])  # some of it is stored from the first


def test_a_notebook_frame_plays(page, folder, tmp_path):
    text = (folder / "replay" / page_name(VIOLATED)).read_text("utf-8")
    file = tmp_path / "notebook.html"
    file.write_text(
        f"<!DOCTYPE html><html data-ready=1><body>{Page(text)._repr_html_()}</body></html>", "utf-8"
    )
    page.open(file.as_uri())
    page.browser.switch_to.frame(0)
    page.wait("document.documentElement.dataset.ready")

    page.run("replay.seek(1.0)")

    assert page.text("clock").startswith("1.00 s")
    page.browser.switch_to.default_content()
