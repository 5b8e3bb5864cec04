"""The list of rollouts: the matrix that filters it, the worst, rows with thumbnails, cards."""

import json
import re

import pytest
from contrast import FAINT
from pages import sections
from stores import write_toy_store

import shiftsim
from shiftsim.data.store.reading import open_store
from shiftsim.report.words import worst_of
from shiftsim.view.build import Gallery, list_page, write_site

PHONE, TABLET, DESK = (390, 844), (800, 600), (1440, 900)
SHOWN = "[...document.querySelectorAll('#list tbody tr')].map((row) => row.innerText)"
CARDS = "[...document.querySelectorAll('#worst li')].map((card) => card.innerText)"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The list of a short run and its replays; the second scenario has no page."""
    out = tmp_path_factory.mktemp("list")
    store = write_toy_store(out / "store", count=2, iterations=100)
    planners = ["constant-velocity", "log-future"]
    noise = ["ou-high", "none", "awgn-low"]
    run = shiftsim.run(planners, noise=noise, store=str(store), workers=1, out=str(out / "run"))
    write_site(out, [Gallery([run], open_store(store))], title="toy")
    write_site(out / "part", [Gallery([run], open_store(store))], title="toy", limit=1)
    return out


@pytest.fixture
def listing(page, folder):
    page.open((folder / "index.html").as_uri())
    return page


def made_row(number, **more):
    row = {"token": f"t{number}", "type": "", "city": "", "planner": "idm", "noise": "ou-low"}
    row |= {"seed": 3, "log": "", "cls": 1.0 - number / 100.0, "failed": "", "at": 4.3}
    row |= {"cause": "at-fault collision", "severity": [0.0, 0.0, -3.0]}
    return row | {"violated": {"NCR": 4.3}, "page": None, "index": 0} | more


def open_rows(page, tmp_path, rows):
    page.open(list_page("made", rows).save(tmp_path / "index.html").as_uri())


def pressed(page):
    found = "[...document.querySelectorAll('#matrix [aria-pressed=true]')]"
    return page.run(f"{found}.map((one) => [one.dataset.planner, one.dataset.noise])")


def cell(page, planner, noise):
    where = f"#matrix [data-planner='{planner}'][data-noise='{noise}']"
    return page.browser.find_element("css selector", where)


class TestMatrix:
    def test_it_has_the_means_of_the_table_and_the_noise_in_order(self, listing, folder):
        heads = listing.run(
            "[...document.querySelectorAll('#matrix thead th')].map((h) => h.innerText)"
        )
        assert heads == ["all", "none", "awgn-low", "ou-high"]
        scores = shiftsim.open_run(folder / "run").scores.to_pylist()
        found = [
            r["cls"] for r in scores if (r["planner"], r["noise"]) == ("log-future", "ou-high")
        ]
        assert cell(listing, "log-future", "ou-high").text == f"{50.0 * sum(found):.2f}"

    def test_a_click_shows_these_rollouts_only_and_another_one_all(self, listing):
        cell(listing, "log-future", "ou-high").click()

        assert listing.text("count") == "2 of 12 rollouts"
        rows = listing.run(SHOWN)
        assert all("log-future" in row and "ou-high, seed 0" in row for row in rows)
        assert pressed(listing) == [["log-future", "ou-high"]]
        title = listing.run("document.querySelector('#worst h2').textContent")
        assert title.endswith("of 2 scenarios: log-future, noise ou-high")

        cell(listing, "log-future", "ou-high").click()

        assert listing.text("count") == "12 of 12 rollouts"
        assert pressed(listing) == [["", ""]]

    def test_headings_choose_by_keyboard_a_planner_or_a_noise(self, listing):
        listing.browser.execute_script("arguments[0].focus()", cell(listing, "log-future", ""))
        listing.press("\ue007")  # enter
        assert listing.text("count") == "6 of 12 rollouts"

        listing.browser.execute_script("arguments[0].focus()", cell(listing, "", "none"))
        listing.press(" ")
        assert listing.text("count") == "4 of 12 rollouts"
        assert pressed(listing) == [["", "none"]]

    def test_the_address_keeps_the_filter(self, listing):
        cell(listing, "log-future", "ou-high").click()
        listing.browser.find_element("id", "find").send_keys("0001")
        listing.wait("byId('count').textContent === '1 of 12 rollouts'")
        address = listing.browser.current_url
        assert address.endswith("#planner=log-future&noise=ou-high&find=0001")

        listing.open(address)

        assert listing.text("count") == "1 of 12 rollouts"
        assert pressed(listing) == [["log-future", "ou-high"]]
        listing.browser.find_element("id", "find").clear()
        cell(listing, "log-future", "ou-high").click()
        assert listing.text("count") == "12 of 12 rollouts"
        assert listing.browser.current_url.endswith("#")

    def test_windows_of_several_lengths_have_no_common_mean(self, page, tmp_path):
        spans = [{"window": "15 s"}, {"window": "4 s"}, {"window": "15 s", "planner": "pdm"}]
        open_rows(page, tmp_path, [made_row(number, **more) for number, more in enumerate(spans)])

        assert cell(page, "idm", "ou-low").find_element("xpath", "..").text == "– 4 s, 15 s"
        assert cell(page, "pdm", "ou-low").text == "98.00"

    def test_no_mean_is_shown_where_rollouts_have_no_score(self, page, tmp_path):
        lost = made_row(3, cls=None, failed="failed: boom", violated={}, at=None)
        other = made_row(4, planner="simple")

        open_rows(page, tmp_path, [made_row(1), made_row(2), lost, other])

        assert cell(page, "idm", "ou-low").text.split() == ["–", "2/3"]
        assert cell(page, "simple", "ou-low").text == "96.00"
        assert "boom" in page.run(SHOWN)[0]


class TestWorst:
    def test_they_come_first_and_lead_to_what_went_wrong(self, listing, folder):
        found = listing.run(CARDS)
        scores = [float(card.split()[0]) for card in found]
        assert scores == sorted(scores)
        assert 1 <= len(found) <= 10

        listing.browser.find_element("css selector", "#worst a").click()
        listing.wait("document.documentElement.dataset.ready && location.hash.startsWith('#t=')")

        assert listing.text("token").split()[0] in found[0]

    def test_they_are_those_of_the_terminal(self, page, folder, tmp_path):
        text = (folder / "index.html").read_text("utf-8")
        rows = json.loads(sections(text)["rows"])
        made = [made_row(number) for number in range(14)]
        made += [made_row(3, cls=0.975, noise="none")]  # a better one of the same scenario
        made += [made_row(30 + n, log="l", cls=0.5, severity=[0.0, 0.0, -n]) for n in range(3)]
        made += [made_row(40, cls=0.5, severity=[], cause=""), made_row(41, cls=None)]
        for some in (rows, made):
            scored = [row for row in some if row["cls"] is not None and row["cls"] < 1.0]
            some = [{**row, "path": ""} for row in some]
            open_rows(page, tmp_path, some)
            found = page.run(
                "worstOf([...rows]).map(([row, alike]) => [row.token, row.seed, alike])"
            )
            expected = worst_of(scored, 10)
            assert found == [[row["token"], row["seed"], alike] for row, alike in expected]

    def test_they_are_in_words_and_without_markup_of_theirs(self, page, tmp_path):
        row = made_row(11, token="<b>x</b>", type="<i>", page="replay/x.html", index=1)
        row["violated"] = {"PER": None, "NCR": 4.3}

        open_rows(page, tmp_path, [row, made_row(0, token="fine")])

        parts = page.run(CARDS)[0].split("\n")
        assert parts[:3] == ["89.00", "<b>x</b>", "<i>"]
        assert parts[-1] == "at-fault collision 4.3\u00a0slittle progress"
        title = page.run("document.querySelector('#worst h2').textContent")
        assert title == "The worst 1 of 2 scenarios"
        link = page.run("document.querySelector('#worst a').href")
        assert link.endswith("replay/x.html#t=4.30&focus=2")


class TestRows:
    def scores(self, page):
        cells = "[...document.querySelectorAll('#list .number')].map((one) => one.textContent)"
        return [float(text) for text in page.run(cells)]

    def test_they_are_sorted_by_a_click_on_the_heading(self, listing):
        assert self.scores(listing) == sorted(self.scores(listing))

        listing.browser.find_element("css selector", "th[data-key=cls]").click()

        assert self.scores(listing) == sorted(self.scores(listing), reverse=True)

    def test_of_a_thousand_a_hundred_are_drawn_until_more_are_asked_for(self, page, tmp_path):
        open_rows(page, tmp_path, [made_row(number % 100, seed=number) for number in range(1000)])
        assert page.text("count") == "1000 of 1000 rollouts, the first 100 shown"
        assert len(page.run(SHOWN)) == 100

        page.click("more")

        assert len(page.run(SHOWN)) == 200

    def test_they_say_in_words_what_went_wrong(self, listing):
        said = " ".join(listing.run(SHOWN))

        assert "drivable area" in said or "collision" in said
        assert not re.search(r"\b(NCR|DAC|EMP|DDC|PER|TTC|SLC|EIC)\b", said)

    def test_one_links_into_its_replay_at_the_violation(self, listing):
        link = listing.browser.find_element("css selector", "#list tbody .token a")
        assert "#t=" in link.get_attribute("href")

        link.click()
        listing.wait("document.documentElement.dataset.ready && window.replay")

        assert listing.run("replay.state.t") > 0

    def test_a_thumbnail_shows_the_road_and_both_paths_within_its_window(self, listing):
        inside = """[...document.querySelectorAll('#list svg.thumbnail')].map((svg) => {
          const [x, y, width, height] = svg.getAttribute("viewBox").split(" ").map(Number);
          return ["expert", "driven"].every((kind) => {
            const box = svg.querySelector(`.${kind}`).getBBox();
            return box.x >= x && box.y >= y && box.x + box.width <= x + width
              && box.y + box.height <= y + height;
          }) && svg.querySelector(".road").getBBox().width > width / 2;
        })"""
        assert listing.run(inside) == [True] * 12
        width = "document.querySelector('#list svg.thumbnail').getBoundingClientRect().width"
        assert listing.run(width) >= 160

    def test_the_thumbnails_of_a_scenario_share_its_road(self, folder):
        looks = json.loads(sections((folder / "index.html").read_text("utf-8"))["looks"])

        assert len(looks["scenes"]) == 2

    def test_one_without_replay_has_no_thumbnail_and_no_link(self, page, folder):
        page.open((folder / "part" / "index.html").as_uri())

        assert page.run("document.querySelectorAll('#list svg.thumbnail').length") == 6
        lone = "#list .token span[title='no replay']"
        assert page.run(f'document.querySelectorAll("{lone}").length') == 6


@pytest.mark.parametrize("mode", ["light", "dark"])
@pytest.mark.parametrize("size", [DESK, TABLET, PHONE])
def test_the_page_fits_every_window_and_can_be_read(page, folder, size, mode, tmp_path):
    page.prefer(mode)

    page.open((folder / "index.html").as_uri(), size)

    assert page.run("document.documentElement.scrollWidth") <= size[0]
    assert page.run(FAINT) == []
    page.shoot(tmp_path / "list.png")


def test_rows_are_cards_on_a_phone(page, folder):
    page.open((folder / "index.html").as_uri(), PHONE)

    rows = page.run(
        """[...document.querySelectorAll('#list tbody tr')].slice(0, 2).map((row) => {
          const [scene, token, causes] = ["scene", "token", "causes"].map(
            (name) => row.querySelector(`.${name}`).getBoundingClientRect());
          return token.left >= scene.right && causes.top >= scene.bottom && causes.right <= 390;
        })"""
    )
    assert rows == [True, True]
