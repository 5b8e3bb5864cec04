"""Pages of a report: no table is cut off, the worst rollouts come first, and one can cite it."""

import pytest
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
