"""The pictures of the documentation, made of a run on the demo's scenarios.

`make pictures` keeps them in docs/images; every page about a feature begins with one.
"""

import os
import re
import shutil
from pathlib import Path

import pytest
from review_servers import reviewing

import shiftsim
from shiftsim.cli import main
from shiftsim.view.build import page_name

pytest.importorskip("matplotlib")
DOCS = Path(__file__).resolve().parents[2] / "docs"
ROUNDABOUT, JUNCTION = "07429ce55070c70e", "01f13ee575198fdf"
PARKED = """[[edit]]
name = "parked"
tokens = ["01f13e"]
type = "nudge_around_parked_vehicle"
spawn = [{at = {ahead_m = 30, left_m = -1.2}, behavior = "stopped"}]
"""
# the first picture of a page is the one of this name
PAGES = {
    "index": "crash.gif",
    "quickstart": "report.png",
    "semantic_shift": "cities.png",
    "state_drift": "tube.png",
    "metrics": "score.png",
    "own_planner": "grid.png",
    "vector_map": "map.png",
    "compare_checkpoints": "forest.png",
    "score_elsewhere": "list.png",
    "own_scenarios": "review.png",
    "edits": "edit.png",
    "training": "carl_training.png",
    "seeing": "replay.png",
}
HAND = {"carl_training.png"}  # of a training that takes hours
TALL = (1200, 960)
LOADED = "document.readyState === 'complete'"


def call(command):
    with pytest.raises(SystemExit) as ended:
        main(command.split())
    assert ended.value.code == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("pictures")


@pytest.fixture(scope="module")
def store(folder):
    return shiftsim.demo_store(str(folder / "demo"))


@pytest.fixture(scope="module")
def run(folder, store):
    """Two planners with and without noise, and their pages."""
    out = folder / "demo-run"
    run = shiftsim.run(
        ["log-future", "idm", "pdm-closed"],
        noise=["none", "ou-low", "ou-high"],
        seeds=[0, 1, 2],
        split="demo-mini",
        limit=8,
        store=str(store.path),
        out=str(out),
    )
    call(f"report {out} --html {folder}/report")
    call(f"report {out} --figures --out {folder}/figures")
    call(f"view {out} --no-open --out {folder}/view -p idm -p pdm-closed")
    return run


def replay(folder, token):
    return (folder / "view" / "replay" / page_name(token)).as_uri()


class Pictures:
    def __init__(self, page, folder):
        self.page, self.folder = page, folder
        page.browser.execute_cdp_cmd("Emulation.setScrollbarsHidden", {"hidden": True})

    def take(self, name, address, *, ready=LOADED, size=(1200, 760), script="", of=""):
        """A picture of a page, or of the element `of`."""
        if ready:
            self.page.open(address, size, ready)
        if script:
            self.page.run(script)
        self.page.browser.execute_async_script("setTimeout(arguments[0], 500)")
        if of:
            target = self.page.browser.find_element("css selector", of)
            assert target.screenshot(str(self.folder / name))
        else:
            self.page.shoot(self.folder / name)


def test_every_picture_of_the_pages_is_made(page, folder, store, run):
    take = Pictures(page, folder).take
    shown = "document.documentElement.dataset.ready"
    view = folder / "view" / "index.html"
    take("replay.png", replay(folder, ROUNDABOUT), ready=shown, script="nextViolation()", size=TALL)
    take("score.png", "", ready="", of="footer")
    tube = replay(folder, JUNCTION) + "#tube=1&t=4&zoom=14&focus=2"
    take("tube.png", tube, ready=shown, size=TALL)
    take("list.png", view.as_uri())
    take("report.png", (folder / "report" / "index.html").as_uri())
    take("forest.png", "", ready="", of="section:has(svg.forest) .wide")
    with reviewing(store.path) as server:
        take("review.png", server.address, ready=shown)
    scenario = store[ROUNDABOUT]
    scenario.map.plot().savefig(folder / "map.png", dpi=110)
    noisy = f"plot {run.path} {ROUNDABOUT} -n ou-high --seed 0"
    call(f"{noisy} --grid --at 2,5,8 --width 7in --out {folder}/grid.png")
    call(f"{noisy} -p idm --speed 2 --width 4.5in --plain --out {folder}/crash.gif")
    (folder / "parked.toml").write_text(PARKED)
    call(f"edits show {folder}/parked.toml 01f13e --store {store.path} --out {folder}/edit.png")
    shutil.copy(folder / "figures" / "cities_demo-mini.png", folder / "cities.png")
    kept = os.environ.get("PICTURES")
    for name in set(PAGES.values()) - HAND:
        assert (folder / name).stat().st_size > 2000
        if kept:
            shutil.copy(folder / name, kept)


@pytest.mark.parametrize("name", PAGES)
def test_the_page_begins_with_its_picture(name):
    text = (DOCS / f"{name}.md").read_text("utf-8")
    first = re.search(r"!\[[^\]]+\]\(images/([^)]+)\)", text)
    assert first is not None
    assert first[1] == PAGES[name]
    assert text[: first.start()].count("\n") < 8
    assert (DOCS / "images" / first[1]).is_file()
