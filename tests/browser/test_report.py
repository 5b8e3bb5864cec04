"""Pages of a report: no table is cut off, the worst rollouts come first, and one can cite it."""

import pytest
from contrast import FAINT
from made_runs import random_scores, write_run
from stores import write_toy_store

import shiftsim
from shiftsim.cli import main
from shiftsim.report.build import citation

pytest.importorskip("matplotlib")
SIZES = [(1440, 900), (800, 600)]
LOADED = "document.readyState === 'complete'"
CUT_OFF = """(() => {
  const cut = [];
  for (const table of document.querySelectorAll("section table")) {
    const box = table.parentElement, style = getComputedStyle(box);
    const within = box.getBoundingClientRect().right <= document.documentElement.clientWidth + 1;
    const fits = table.getBoundingClientRect().width <= box.clientWidth + 1;
    if (!within || !(fits || style.overflowX === "auto")) cut.push(table.closest("section").id);
    box.scrollLeft = 1e6;
    const last = table.rows[0].cells[table.rows[0].cells.length - 1].getBoundingClientRect();
    if (last.right > box.getBoundingClientRect().right + 1) cut.push("end of " + box.ariaLabel);
    box.scrollLeft = 0;
  }
  return cut;
})()"""


def call(*words):
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words), "--quiet"])
    assert ended.value.code == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A report of a run with many columns, and the pages of a real one."""
    out = tmp_path_factory.mktemp("report")
    cities = ("Sindelfingen", "San Francisco", "Stuttgart", "Munich")
    noise = ("none", "awgn-low", "awgn-mid", "awgn-high", "ou-low", "ou-mid", "ou-high")
    planners = ("alpha", "a-planner-with-a-long-name")
    settings = {"planners": planners, "noise": noise, "seeds": (0, 1), "cities": cities}
    write_run(out / "wide", score=random_scores(3), **settings)
    call("report", out / "wide", "--figures", "--published", "-f", "html", "--out", out / "one")
    store = write_toy_store(out / "store", count=2, iterations=60)
    shiftsim.run(
        ["constant-velocity", "log-future"],
        noise=["none", "ou-high"],
        store=str(store),
        workers=1,
        out=str(out / "run"),
    )
    call("report", out / "run", "--html", out / "site")
    call("view", out / "run", "--no-open", "--out", out / "view")
    return out


@pytest.mark.parametrize("size", SIZES)
def test_no_table_of_a_report_is_cut_off(page, folder, size, tmp_path):
    page.open((folder / "one" / "report.html").as_uri(), size, LOADED)
    assert page.run(CUT_OFF) == []
    assert page.run("document.documentElement.scrollWidth") <= size[0]
    assert page.run("document.querySelectorAll('section table').length") >= 8
    page.shoot(tmp_path / "report.png")


def test_a_wide_table_scrolls_within_its_own_box_by_keyboard(page, folder):
    page.open((folder / "one" / "report.html").as_uri(), (800, 600), LOADED)
    box = "document.querySelector('#scores .wide')"
    assert page.run(f"{box}.scrollWidth > {box}.clientWidth")
    page.browser.execute_script(f"{box}.focus()")
    page.press("\ue014")  # to the right
    page.wait(f"{box}.scrollLeft > 0")
    assert page.run("window.scrollX") == 0


@pytest.mark.parametrize("name", ["site", "view"])
@pytest.mark.parametrize("size", SIZES)
def test_pages_with_replays_fit_the_window(page, folder, name, size, tmp_path):
    page.open((folder / name / "index.html").as_uri(), size)
    assert page.run(CUT_OFF) == []
    assert page.run("document.documentElement.scrollWidth") <= size[0]
    page.shoot(tmp_path / f"{name}.png")


def test_headings_say_the_words_before_the_abbreviation(page, folder):
    page.open((folder / "one" / "report.html").as_uri(), ready=LOADED)
    heads = page.run("[...document.querySelectorAll('#scores th')].map((th) => th.innerText)")
    assert " ".join(heads[3].split()) == "no at-fault collision NCR"


def test_a_report_begins_with_ranking_sentences_and_robustness_and_has_contents(page, folder):
    page.open((folder / "one" / "report.html").as_uri(), ready=LOADED)
    above = page.run(
        """[...document.querySelectorAll(".overview section")].map((section) => [
          section.querySelector("h2").textContent,
          section.querySelector("img, table").getBoundingClientRect().bottom])"""
    )
    assert [title.split()[0] for title, _ in above] == ["Ranking:", "Noise"]
    assert max(bottom for _, bottom in above) <= SIZES[0][1]  # on the first screen
    said = page.run("[...document.querySelectorAll('.finding')].map((p) => p.textContent)")
    assert len(said) == 3
    assert all(sentence.endswith(".") for sentence in said)
    links = page.run("[...document.querySelectorAll('nav a')].map((link) => link.hash.slice(1))")
    ids = page.run("[...document.querySelectorAll('.report section')].map((one) => one.id)")
    assert sorted(links) == sorted(ids)


def test_pairs_are_a_forest_plot_with_one_zero_line(page, folder):
    page.open((folder / "one" / "report.html").as_uri(), ready=LOADED)
    lines = page.run(
        """[...document.querySelectorAll("#planner-comparison-noise tbody tr")].map((row) => {
          const [zero, interval, mean] = row.querySelector("svg").children;
          const at = (element) => element.getBoundingClientRect();
          const [low, high] = [at(interval).left, at(interval).right];
          const text = row.querySelector("svg").parentElement.textContent;
          return [at(zero).left, low, at(mean).left + at(mean).width / 2, high, Number(text)];
        })"""
    )
    assert len(lines) == 6
    assert len({round(zero) for zero, *_ in lines}) == 1
    for zero, low, mean, high, difference in lines:
        assert low <= mean <= high
        assert (mean > zero) == (difference > 0.0)
    page.open((folder / "one" / "report.html").as_uri(), (390, 844), LOADED)
    room = page.run(
        """[...document.querySelectorAll("#planner-comparison td svg")].map((svg) => {
          const text = document.createRange();
          text.selectNodeContents(svg.parentElement.lastChild);
          return text.getBoundingClientRect().left - svg.getBoundingClientRect().right;
        })"""
    )
    assert min(room) > 0  # between the plot and the number, also on a phone
    heads = page.run("document.querySelector('#planner-comparison thead svg').textContent")
    assert "0" in heads


def test_the_planner_stays_in_sight_while_a_wide_table_scrolls(page, folder):
    page.open((folder / "one" / "report.html").as_uri(), (390, 844), LOADED)
    left = page.run(
        """(() => {
          const box = document.querySelector("#scores .wide");
          box.scrollLeft = 300;
          const cell = box.querySelector("tbody td");
          const place = (element) => element.getBoundingClientRect().left;
          const ground = getComputedStyle(cell).backgroundColor;
          return [cell.textContent, place(cell) - place(box), box.scrollLeft, ground];
        })()"""
    )
    assert left[:3] == ["alpha", 0, 300]
    assert left[3] != "rgba(0, 0, 0, 0)"  # what scrolls is hidden behind it
    assert page.run("document.documentElement.scrollWidth") <= 390


def test_the_best_of_each_setting_is_bold(page, folder):
    page.open((folder / "one" / "report.html").as_uri(), ready=LOADED)
    rows = page.run(
        """[...document.querySelectorAll("#noise-robustness tbody tr")].map((row) =>
          [...row.querySelectorAll(".n")].map((cell) =>
            [parseFloat(cell.textContent), getComputedStyle(cell).fontWeight === "700"]))"""
    )
    for column in zip(*rows[:2], strict=True):  # the run's own, before the published ones
        best = max(value for value, _ in column)
        assert [is_bold for _, is_bold in column] == [value == best for value, _ in column]


@pytest.mark.parametrize("name", ["one/report.html", "site/index.html"])
@pytest.mark.parametrize("mode", ["light", "dark"])
def test_a_report_can_be_read(page, folder, name, mode):
    page.prefer(mode)
    page.open((folder / name).as_uri(), ready=LOADED)
    assert page.run(FAINT) == []
    ground = page.run("getComputedStyle(document.body).backgroundColor.match(/\\d+/)[0]")
    assert (int(ground) < 60) == (mode == "dark")


def test_printed_no_table_of_a_report_is_cut_off(page, folder):
    page.open((folder / "site" / "index.html").as_uri(), ready=LOADED)
    page.emulate("print")
    boxes = "[...document.querySelectorAll('.report .wide')]"
    assert set(page.run(f"{boxes}.map((box) => getComputedStyle(box).overflowX)")) == {"visible"}


def test_a_click_on_the_citation_selects_all_of_it(page, folder):
    page.open((folder / "one" / "report.html").as_uri(), ready=LOADED)
    page.browser.find_element("css selector", "pre").click()
    chosen = page.run("getSelection().toString()")
    assert chosen.strip() == citation([shiftsim.open_run(folder / "wide")])


def test_noise_is_dashed_and_hollow_in_a_replay_as_in_all_pictures(page, folder):
    page.open(next((folder / "view" / "replay").glob("*.html")).as_uri())
    looks = page.run(
        """(() => {
          const egos = new Set(), marks = new Set(), [ego, mark] = [drawEgo, drawMarker];
          const colours = meta.rollouts.map((one) => one.colour);
          window.drawEgo = (...a) => colours.includes(a[4]) && egos.add(Boolean(a[6].length));
          window.drawMarker = (...a) => marks.add(a[6]);
          draw();
          [window.drawEgo, window.drawMarker] = [ego, mark];
          const box = document.createElement("canvas");
          const pen = box.getContext("2d", {willReadFrequently: true});
          const centre = (hollow) => {
            drawMarker(pen, "s", 20, 20, 9, "#125ced", hollow);
            return [...pen.getImageData(20, 20, 1, 1).data];
          };
          return [[...egos].sort(), [...marks].sort(), centre(false), centre(true)];
        })()"""
    )
    both = [False, True]
    assert looks == [both, both, [0x12, 0x5C, 0xED, 255], [255, 255, 255, 255]]
