"""Replays: how long a set of pages takes to make, how large it is, and how fast a page draws."""

import shutil
from dataclasses import replace
from time import perf_counter

import numpy as np
import pytest

import shiftsim
from shiftsim.benchmarks.speed.city import bench_scene
from shiftsim.data.store.reading import open_store
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import simulate
from shiftsim.view.build import Gallery, write_site
from shiftsim.view.page import replay_page
from shiftsim.view.scene import ShownRollout

SCENARIOS, PLANNERS = 60, ("log-future", "idm", "constant-velocity")
SEEKS = 150


def report(name, value, target, unit):
    """One line: a figure, and whether it meets its target."""
    verdict = "met" if value <= target else "MISSED"
    print(f"  {name:34} {value:9.1f} {unit:5} target {target:g}: {verdict}")


def test_a_set_of_replays(tmp_path, size):
    scenarios = size(SCENARIOS, 2)
    run = shiftsim.run(PLANNERS, all_scenarios=True, limit=scenarios, out=str(tmp_path / "run"))
    store = open_store(run.manifest["store"])
    write_site(tmp_path / "warm", [Gallery([run], store)], title="warm", limit=2)

    began = perf_counter()
    pages = write_site(tmp_path / "site", [Gallery([run], store)], title="bench")
    seconds = perf_counter() - began
    size = sum(path.stat().st_size for path in (tmp_path / "site").rglob("*.html")) / 1e6

    print(f"\nreplays of {pages} scenarios x {len(PLANNERS)} planners")
    report("made in", seconds, 15, "s")
    report("size in all", size, 30, "MB")
    assert pages == scenarios


@pytest.fixture
def browser(tmp_path):
    webdriver = pytest.importorskip("selenium.webdriver")
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("NOT COVERED: no chromium or chromedriver on this machine")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for flag in ("headless=new", "no-sandbox", "disable-gpu", f"user-data-dir={tmp_path / 'p'}"):
        options.add_argument(f"--{flag}")
    started = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    metrics = {"width": 1440, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    started.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    started.set_script_timeout(120)
    yield started
    started.quit()


def test_a_page_with_300_agents(tmp_path, size, browser):
    scene = bench_scene(300, 0)
    scene = replace(scene, token="300agents")
    planner = load_planner("constant-velocity")
    shown = [
        ShownRollout("constant-velocity", noise, 0, simulate(scene, planner, noise=noise))
        for noise in ("none", "awgn-high", "ou-high")
    ]
    file = tmp_path / "page.html"
    file.write_text(replay_page(scene, shown), "utf-8")

    firsts = []
    for _ in range(size(5)):
        browser.get("about:blank")
        browser.get(file.as_uri())
        while not browser.execute_script("return document.documentElement.dataset.ready"):
            pass
        firsts.append(browser.execute_script("return window.firstFrame"))
    # the whole picture anew each time: a far seek moves everything; reading a pixel ends the frame
    times = browser.execute_async_script(
        """const [count, done] = arguments;
        const pen = document.getElementById("scene").getContext("2d");
        const end = duration(), out = [];
        for (let i = 0; i < count; i++) {
          const t = end * ((i * 0.6180339887) % 1);
          const began = performance.now();
          replay.seek(t);
          pen.getImageData(0, 0, 1, 1);
          out.push(performance.now() - began);
        }
        done(out);""",
        size(SEEKS, 3),
    )

    agents = len(scene.tracks.tokens)
    print(f"\none page, {agents} agents, {len(shown)} rollouts, {file.stat().st_size / 1e3:.0f} kB")
    report("first frame, median of 5", float(np.median(firsts)), 2000, "ms")
    report("full redraw, median", float(np.median(times)), 33, "ms")
    report("full redraw, p95", float(np.percentile(times, 95)), 60, "ms")
