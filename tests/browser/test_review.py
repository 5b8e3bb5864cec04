import json

import pytest
from contrast import FAINT
from review_servers import reviewing
from stores import write_toy_store

import shiftsim
from shiftsim.data.store.tables import REVIEW
from shiftsim.runs.filter import FilterConfig, filter_store

SIZES = [(1440, 900), (800, 600)]
FIRST, SECOND = "0000cafe", "0001cafe"


@pytest.fixture
def store(tmp_path):
    return write_toy_store(tmp_path / "toy", count=2)


@pytest.fixture
def server(store):
    with reviewing(store) as running:
        yield running


@pytest.fixture
def desk(page, server):
    page.open(server.address)
    return page


def kept(store):
    path = store / REVIEW
    lines = path.read_text().splitlines() if path.exists() else []
    return {row["token"]: row for row in map(json.loads, lines)}


def current(page):
    return page.text("token")


def block_on_screen(page, block):
    """A point of the scene that shows a roadblock."""
    return page.run(
        f"""(() => {{ for (let y = 5; y < panel.height; y += 8)
          for (let x = 5; x < panel.width; x += 8) if (blockAt(x, y) === {block!r}) return [x, y];
        }})()"""
    )


@pytest.mark.parametrize("size", SIZES)
def test_the_page_loads_without_complaints_and_fits_the_window(page, server, size, tmp_path):
    page.open(server.address, size)

    assert current(page) == FIRST
    assert page.run("document.documentElement.scrollWidth") <= size[0]
    assert page.run("document.documentElement.scrollHeight") <= size[1]
    page.shoot(tmp_path / "review.png")


def test_the_list_has_thumbnail_city_and_why_the_filter_dropped_a_scenario(page, store):
    filter_store(store, FilterConfig(min_path_m=16.0), workers=1)
    with reviewing(store) as server:
        page.open(server.address)
        page.wait("document.querySelectorAll('nav svg.thumbnail').length === 2")

        lines = page.run("[...document.querySelectorAll('nav li')].map((line) => line.innerText)")
        faint = page.run(f"{FAINT}.filter((text) => !/ (recorded route|undo|[uo])$/.test(text))")
        drawn = page.run("document.querySelector('nav .expert').getBoundingClientRect().width")

    assert [line.split("\n")[0] for line in lines] == [FIRST, SECOND]
    assert "straight" in lines[0]
    assert "dropped: path too short" in lines[0]
    assert drawn > 10
    assert faint == []  # but for buttons that cannot be used now


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_it_can_be_read_as_the_system_has_it_and_by_its_key(page, store, mode):
    page.prefer(mode)
    faint = f"{FAINT}.filter((text) => !/ (recorded route|undo|[uo])$/.test(text))"
    with reviewing(store) as server:
        page.open(server.address)
        page.run("byId('which').value = 'all'")
        grounds, drawn = [], []
        for _ in range(2):  # the system's, and the other one
            page.press("r")  # what was decided has a ground of its own
            page.wait(f"document.getElementById('token').textContent === {SECOND!r}")
            page.press("b")
            page.wait("document.getElementById('reject').classList.contains('on')")
            assert page.run(faint) == []
            grounds.append(page.run("luminance(COLOURS.paper) > 0.5"))
            drawn.append(page.pixels())
            page.press("u", "d")
            page.wait("!document.getElementById('reject').classList.contains('on')")
    assert grounds == [mode == "light", mode != "light"]
    assert drawn[0] != drawn[1]


def test_on_a_phone_the_list_is_a_strip_above_the_scene(page, server):
    page.open(server.address, (390, 844))

    strip, stage = page.run(
        "['list', 'stage'].map((id) => document.getElementById(id).getBoundingClientRect())"
        ".map(({ top, bottom, width }) => ({ top, bottom, width }))"
    )
    assert page.run("document.documentElement.scrollWidth") <= 390
    assert strip["bottom"] <= stage["top"] + 1
    assert stage["width"] == page.run("document.documentElement.clientWidth")


def test_a_decision_is_kept_at_once_and_leads_on(desk, store):
    desk.press("a")
    desk.wait(f"document.getElementById('token').textContent === {SECOND!r}")

    assert kept(store)[FIRST]["decision"] == "accept"
    assert kept(store)[FIRST]["reviewer"] == "me"


def test_undo_takes_back_the_last_step(desk, store):
    desk.press("r")
    desk.wait(f"document.getElementById('token').textContent === {SECOND!r}")
    desk.press("u")
    desk.wait(f"document.getElementById('token').textContent === {FIRST!r}")
    desk.wait("!document.getElementById('reject').classList.contains('on')")

    assert kept(store) == {}


def test_comments_are_kept_and_keys_in_them_are_letters(desk, store):
    desk.press("c")
    desk.press("a rare bus")
    desk.press("\ue00c")  # escape
    desk.wait("document.getElementById('kept').textContent === 'kept'")

    assert kept(store)[FIRST] | {"version": ""} == {
        "token": FIRST,
        "decision": "",
        "comment": "a rare bus",
        "route": None,
        "reviewer": "me",
        "version": "",
    }
    assert current(desk) == FIRST


def test_a_click_takes_a_roadblock_out_and_another_puts_it_back(desk, store):
    x, y = block_on_screen(desk, "1")

    desk.click_at(x, y)
    desk.wait("document.querySelectorAll('#blocks li').length === 2")

    assert kept(store)[FIRST]["route"] == ["2", "3"]
    assert "the ego starts on 1" in desk.text("problems")

    desk.click_at(x, y)
    desk.wait("document.querySelectorAll('#blocks li').length === 3")

    assert kept(store) == {}
    assert desk.text("problems") == "the route is connected"


def test_a_corrected_route_changes_a_run_and_its_fingerprint(desk, store, tmp_path):
    before = shiftsim.run("log-future", store=str(store), workers=1, out=str(tmp_path / "before"))
    desk.press("-", "-", "-", "-", "-", "-", "-", "-")
    x, y = block_on_screen(desk, "3")

    desk.click_at(x, y)
    desk.wait("document.querySelectorAll('#blocks li').length === 2")
    after = shiftsim.run("log-future", store=str(store), workers=1, out=str(tmp_path / "after"))

    assert before.manifest["determining"] != after.manifest["determining"]
    opened = shiftsim.open_store(str(store))
    assert opened.read(FIRST).route == ("1", "2")


def test_a_rejected_scenario_is_left_out_of_a_run(desk, store, tmp_path):
    desk.press("r")
    desk.wait(f"document.getElementById('token').textContent === {SECOND!r}")

    run = shiftsim.run("log-future", store=str(store), workers=1, out=str(tmp_path / "run"))

    assert run.scores["token"].to_pylist() == [SECOND]


def test_reloading_goes_on_where_it_was(desk, store):
    desk.press("n")
    desk.wait(f"document.getElementById('token').textContent === {SECOND!r}")
    desk.press("r")
    desk.wait("document.getElementById('reject').classList.contains('on')")

    desk.browser.refresh()
    desk.wait(f"document.documentElement.dataset.ready === {SECOND!r}")

    assert desk.run("document.getElementById('reject').classList.contains('on')")


def test_play_moves_the_recording(desk):
    before = desk.pixels()

    desk.press(" ")
    desk.wait("state.t > 0.2")

    assert desk.pixels() != before
