"""The site of the documentation: it fits a phone, can be read in both modes, and searches."""

import shutil
import subprocess
import sys

import pytest
from contrast import FAINT
from places import REPOSITORY

LOADED = "document.readyState === 'complete'"
PHONE, DESK = (390, 844), (1440, 900)

# words of code in tables that are broken across lines
BROKEN = """[...document.querySelectorAll("article table code")].flatMap((code) => {
  const texts = document.createTreeWalker(code, NodeFilter.SHOW_TEXT), found = [];
  while (texts.nextNode()) {
    for (const { 0: word, index } of texts.currentNode.data.matchAll(/\\w+/g)) {
      const range = document.createRange();
      range.setStart(texts.currentNode, index);
      range.setEnd(texts.currentNode, index + word.length);
      const tops = [...range.getClientRects()].map((box) => Math.round(box.top));
      if (new Set(tops).size > 1) found.push(word);
    }
  }
  return found;
})"""


@pytest.fixture(scope="module")
def site():
    """The built site; Zensical writes nowhere but inside the repository."""
    pytest.importorskip("zensical", reason="needs the dependency group `docs`")
    folder = REPOSITORY / "build" / "browsed"
    command = [sys.executable, "tools/build_site.py", "build/browsed"]
    subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True)
    yield folder
    shutil.rmtree(folder)


def test_every_page_fits_a_phone_breaks_no_code_in_tables_and_asks_no_other_server(page, site):
    for path in sorted(site.rglob("*.html")):
        if path.name == "404.html":
            continue  # for the root of a server
        page.open(path.as_uri(), PHONE, LOADED)
        assert page.run("document.documentElement.scrollWidth") <= PHONE[0], path.name
        page.run("document.querySelectorAll('.rules details').forEach((one) => (one.open = true))")
        assert page.run(BROKEN) == [], path.name
        asked = page.run("performance.getEntriesByType('resource').map((entry) => entry.name)")
        assert [name for name in asked if not name.startswith("file:")] == []


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_text_stands_out_from_its_ground(page, site, mode):
    page.prefer(mode)
    schemes = {"light": "default", "dark": "slate"}
    for name in ("index", "quickstart", "metrics", "nuplan_rules", "api", "api/run", "api/command"):
        page.open((site / f"{name}.html").as_uri(), DESK, LOADED)
        page.wait(f"document.body.dataset.mdColorScheme === '{schemes[mode]}'")
        assert page.run(FAINT) == []


@pytest.mark.parametrize(
    ("words", "place"), [("time to collision", "metrics.html"), ("open_run", "api/run.html")]
)
def test_the_search_finds_metrics_and_pages_of_the_api(page, site, words, place):
    page.open((site / "index.html").as_uri(), DESK, LOADED)
    page.browser.find_element("css selector", ".md-search__button").click()
    page.wait("!!document.activeElement.shadowRoot?.activeElement")
    page.press(words)
    page.wait(f"!!document.activeElement.shadowRoot.querySelector('a[href*=\"{place}\"]')")


def test_the_rules_are_a_table_that_can_be_filtered(page, site):
    page.open((site / "nuplan_rules.html").as_uri(), DESK, LOADED)
    rows = "[...document.querySelectorAll('.rules tr:has(details)')]"
    shown = f"{rows}.filter((row) => row.checkVisibility())"
    everything = page.run(f"{shown}.length")
    assert everything > 200
    box = page.browser.find_element("css selector", ".rules-filter input")
    box.send_keys("expert one sample")
    page.wait(f"{shown}.length < 10")
    assert "71" in page.run(f"{shown}.map((row) => row.cells[0].textContent)")
    assert page.run("document.querySelector('[role=status]').textContent") != ""


def test_a_link_to_a_rule_opens_it(page, site):
    address = (site / "nuplan_rules.html").as_uri()
    page.open(f"{address}#71-the-expert-has-one-sample-more-than-the-ego", DESK, LOADED)
    page.wait(
        "document.querySelector('.rules details[open]')?.textContent.includes('T - 1 samples')"
    )
