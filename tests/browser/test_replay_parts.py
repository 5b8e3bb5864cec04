"""The score waterfall, the noise tube, the fork, the dark page and the turned view of a replay."""

import numpy as np
import pytest
from stores import write_toy_store

import shiftsim
from shiftsim.data.store.reading import open_store
from shiftsim.report.palette import _KNOWN, _OTHERS
from shiftsim.view.build import Gallery, page_name, write_site

VIOLATED = "0001cafe"  # its ego meets a parked car
LOSSES = "document.querySelectorAll('#waterfall .loss')"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Replays of a run with three seeds, and one with forks."""
    out = tmp_path_factory.mktemp("parts")
    store = write_toy_store(out / "store", count=2, iterations=100)
    run = shiftsim.run(
        ["constant-velocity", "log-future"],
        noise=["none", "ou-high"],
        seeds=[0, 1, 2],
        store=str(store),
        workers=1,
        out=str(out / "run"),
    )
    gallery = Gallery([run], open_store(store))
    write_site(out, [gallery], title="toy")
    for name, one in gallery.pages(VIOLATED, fork=True).items():
        one.save(out / "replay" / f"fork-{name}")
    return out


@pytest.fixture
def replay(page, folder):
    page.open((folder / "replay" / page_name(VIOLATED)).as_uri())
    return page


@pytest.fixture
def forked(page, folder):
    page.open((folder / "replay" / f"fork-{page_name(VIOLATED)}").as_uri())
    return page


def focus_on_losses(page, least=1):
    """The first rollout that loses something so many times; its place."""
    index = page.run(f"meta.rollouts.findIndex((r) => r.losses.length >= {least})")
    page.run(f"setFocus({index})")
    return index


class TestWaterfall:
    def test_losses_sum_to_the_score_also_as_they_are_told(self, replay):
        for rollout in replay.run("meta.rollouts"):
            left = 100.0 - sum(loss["points"] for loss in rollout["losses"])
            assert left == pytest.approx(100.0 * rollout["cls"], abs=1e-9)
            told = [float(loss["told"].replace("−", "")) for loss in rollout["losses"]]
            assert 100.0 - sum(told) == pytest.approx(round(100.0 * rollout["cls"], 2), abs=1e-6)

    def test_each_loss_stands_at_its_second_and_is_as_high_as_what_it_takes(self, replay):
        index = focus_on_losses(replay)
        boxes = replay.run(
            f"[...{LOSSES}].map((g) => g.querySelector('rect:not(.reach)'))"
            ".map((r) => ['x', 'y', 'width', 'height'].map((name) => r[name].baseVal.value))"
        )
        losses = replay.run(f"meta.rollouts[{index}].losses")
        assert len(boxes) == len(losses) >= 1
        for (x, _, width, height), loss in zip(boxes, losses, strict=True):
            at = replay.run("duration()") if loss["t"] is None else loss["t"]
            assert x + width / 2 == pytest.approx(replay.run(f"strips.x({at})"), abs=0.5)
            assert height == pytest.approx(max(0.36 * loss["points"], 3.0), abs=0.01)

    @pytest.mark.parametrize("by", ["click", "keyboard"])
    def test_a_loss_leads_to_its_moment(self, replay, by):
        from selenium.webdriver.common.keys import Keys

        index = focus_on_losses(replay)
        loss = replay.run(f"meta.rollouts[{index}].losses.find((one) => one.t !== null)")
        place = replay.run(f"meta.rollouts[{index}].losses.findIndex((one) => one.t !== null)")
        if by == "click":
            replay.browser.find_elements("css selector", "#waterfall .loss")[place].click()
        else:
            replay.run(f"{LOSSES}[{place}].focus()")
            replay.press(Keys.ENTER)

        assert replay.run("state.t") == pytest.approx(loss["t"], abs=1e-6)
        assert replay.text("said").endswith(loss["words"])
        assert replay.run("state.focus") == index

    def test_it_is_of_the_rollout_in_focus(self, replay):
        for index, rollout in enumerate(replay.run("meta.rollouts")):
            replay.run(f"setFocus({index})")
            assert replay.run(f"{LOSSES}.length") == len(rollout["losses"])
            score = f"{round(100 * rollout['cls'], 2):g}"
            assert replay.text("waterfall").startswith(f"score {score} of {rollout['planner']}")

    def test_words_of_losses_lie_on_nothing(self, replay):
        for index in range(replay.run("meta.rollouts.length")):
            replay.run(f"setFocus({index})")
            boxes = replay.run(
                "[...document.querySelectorAll('#waterfall .loss text')]"
                ".map((one) => one.getBBox())"
                ".map(({ x, y, width, height }) => [x, y, x + width, y + height])"
            )
            for i, a in enumerate(boxes):
                assert 0 <= a[0]
                assert a[2] <= replay.run("byId('waterfall').clientWidth")
                for b in boxes[:i]:
                    assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] + 4 or b[3] <= a[1] + 4


class TestTube:
    def test_it_is_the_area_between_the_paths_of_all_seeds(self, replay):
        tube = replay.run("tubes.findIndex((one) => one.planner === 'constant-velocity')")
        assert tube >= 0
        seeds = replay.run(
            "meta.rollouts.map((r, i) => [r, i]).filter(([r]) => r.planner === 'constant-velocity'"
            " && r.noise === 'ou-high').map(([, i]) => [...rollouts[i].get('ego.xy').data])"
        )
        assert len(seeds) >= 2
        row = 60
        points = [(path[2 * row], path[2 * row + 1]) for path in seeds]
        middle = np.mean(points, axis=0)
        inside = f"context.isPointInPath(tubes[{tube}].area, x, y, 'evenodd')"
        script = f"((x, y) => {{ context.setTransform(1, 0, 0, 1, 0, 0); return {inside}; }})"
        assert replay.run(f"{script}({middle[0]}, {middle[1]})")
        assert not replay.run(f"{script}({middle[0]}, {middle[1] + 50})")
        across = replay.run(f"[...tubes[{tube}].across]")
        assert across[0] == 0
        assert max(across) > 0.05

    def test_the_key_shows_it_with_its_widths_as_curves(self, replay):
        before, curves = replay.pixels(), replay.run("strips.curves.length")
        labels = "strips.curves.map((one) => one.label)"
        assert "seeds apart, across" not in replay.run(labels)

        replay.press("n")

        assert replay.run("state.tube && byId('tube').checked")
        assert replay.pixels() != before
        assert replay.run(labels)[curves:] == ["seeds apart, across", "seeds apart, along"]
        assert "tube=1" in replay.run("location.hash")

    def test_what_its_seeds_violate_are_dots_with_words(self, replay):
        replay.press("n")
        dots = replay.run("state.dots")
        expected = replay.run("tubes.reduce((sum, tube) => sum + tube.dots.length, 0)")
        assert len(dots) == expected >= 1
        x, y, words = dots[0]
        replay.run(f"zoom(1, {x}, {y})")
        assert words in replay.run(f"describeAt(panels[0], {x}, {y})")

    def test_without_seeds_there_is_no_option(self, page, folder, tmp_path):
        run = shiftsim.open_run(folder / "run")
        from shiftsim.view.build import Choice

        gallery = Gallery([run], open_store(run.manifest["store"]), Choice(seeds=(0,)))
        file = gallery.page(VIOLATED).save(tmp_path / "one.html")
        page.open(file.as_uri())

        assert page.run("byId('tube').parentElement.hidden")
        page.press("n")
        assert not page.run("state.tube")


class TestFork:
    def test_the_key_leads_to_the_last_chance_and_draws_what_follows(self, forked):
        index = forked.run("meta.rollouts.findIndex((r) => r.fork && r.fork.branches.length)")
        assert index >= 0
        forked.run(f"setFocus({index})")
        fork = forked.run("meta.rollouts[state.focus].fork")
        hit = forked.run("meta.rollouts[state.focus].violations.find((v) => v.short === 'NCR').t")

        forked.press("k")

        assert forked.run("state.fork")
        assert forked.run("state.t") == pytest.approx(fork["t"])
        assert fork["t"] < hit
        assert any(one["hit"] is None for one in fork["branches"])
        assert fork["branches"][0]["name"] == "braking"
        for one in fork["branches"]:
            assert f"{one['name']} {one['words']}" in forked.text("said")
        drawn = forked.pixels()
        forked.press("k")
        assert not forked.run("state.fork")
        assert forked.pixels() != drawn

    def test_branches_begin_where_the_rollout_is(self, forked):
        index = forked.run("meta.rollouts.findIndex((r) => r.fork && r.fork.branches.length)")
        fork = forked.run(f"meta.rollouts[{index}].fork")
        for number in range(len(fork["branches"])):
            first = forked.run(f"[...rollouts[{index}].get('branch{number}.xy').data].slice(0, 2)")
            row = 2 * fork["row"]
            at = forked.run(f"[...rollouts[{index}].get('ego.xy').data].slice({row}, {row} + 2)")
            assert first == pytest.approx(at, abs=0.011)

    def test_pages_without_forks_have_no_option(self, replay):
        assert replay.run("byId('fork').parentElement.hidden")
        replay.press("k")
        assert not replay.run("state.fork")


def luminance(colour):
    value = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one, other):
    light, dark = sorted((luminance(one), luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def over(colour, ground):
    """A colour `rgba(r, g, b, a)` on a ground `#rrggbb`."""
    *parts, share = (float(text) for text in colour[5:-1].split(","))
    below = [int(ground[i : i + 2], 16) for i in (1, 3, 5)]
    mixed = (round(a * share + b * (1 - share)) for a, b in zip(parts, below, strict=True))
    return "#" + "".join(f"{value:02x}" for value in mixed)


# colours of the pixels across a path of a colour on a ground
ACROSS_A_PATH = """(() => {
  const pen = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  pen.fillStyle = "%(ground)s";
  pen.fillRect(0, 0, 40, 40);
  const colour = isDark() ? lightened("%(colour)s") : "%(colour)s";
  const panel = { toScreen: (x, y) => [x, y] };
  drawPath(pen, [0, 20.5, 40, 20.5], { row: 1 }, panel, colour, [], 1.8);
  const hex = (value) => value.toString(16).padStart(2, "0");
  const at = (y) => [...pen.getImageData(20, y, 1, 1).data].slice(0, 3).map(hex).join("");
  return [...Array(40).keys()].map((y) => `#${at(y)}`);
})()"""


class TestColours:
    @pytest.mark.parametrize("theme", ["light", "dark"])
    def test_what_carries_meaning_stands_out(self, replay, theme):
        replay.run(f"setTheme({str(theme == 'dark').lower()})")
        style = "getComputedStyle(document.documentElement)"
        names = replay.run("[...Object.keys(COLOURS), 'raised', 'link', 'edited-ground']")
        c = {n: replay.run(f"{style}.getPropertyValue('--{n}').trim()") for n in names}
        c["route"] = over(c["route"], c["drivable"])
        for text in ("ink", "soft", "link", "alarm-ink"):
            assert contrast(c[text], c["paper"]) >= 4.5, text
        assert contrast(c["ink"], c["raised"]) >= 4.5
        assert contrast(c["ink"], c["edited-ground"]) >= 4.5
        assert contrast(c["edged"], c["paper"]) >= 3.0
        for ground in ("drivable", "route", "ground", "walkway", "crosswalk"):
            for shape in ("vehicle", "pedestrian", "bicycle", "object"):
                best = max(contrast(c[shape], c[ground]), contrast(c["edge"], c[ground]))
                assert best >= 3.0, (shape, ground)
            if ground != "crosswalk":
                assert contrast(c["alarm"], c[ground]) >= 3.0, ground
                assert contrast(c["recorded"], c[ground]) >= 3.0, ground
        assert contrast(c["drivable"], c["ground"]) >= 1.35
        assert contrast(c["route"], c["drivable"]) >= 1.3

    @pytest.mark.parametrize("theme", ["light", "dark"])
    def test_paths_of_planners_stand_out_from_the_road(self, replay, theme):
        replay.run(f"setTheme({str(theme == 'dark').lower()})")
        road = replay.run("COLOURS.drivable")
        for style in (*_KNOWN.values(), *_OTHERS):
            for ground in (road, over(replay.run("COLOURS.route"), road)):
                drawn = replay.run(ACROSS_A_PATH % {"ground": ground, "colour": style.colour})
                assert max(contrast(one, ground) for one in drawn) >= 3.0, (style, ground)
                if theme == "light":  # its own colour is seen, on a dark edge where it is bright
                    assert drawn[20] == style.colour

    def test_the_page_follows_the_system_and_the_key_turns_it(self, replay):
        assert replay.run("document.documentElement.dataset.theme") == "light"
        replay.prefer("dark")
        replay.wait("isDark()")
        dark = replay.pixels()

        replay.press("d")

        assert not replay.run("isDark()")
        assert replay.pixels() != dark
        replay.browser.execute_script("localStorage.clear()")


def test_each_noise_is_one_curve_with_steering_beside(replay):
    curves = replay.run("strips.curves.filter((one) => one.label.startsWith('noise on'))")
    noises = replay.run(
        "new Set(visible().map((i) => meta.rollouts[i]).filter((r) => r.noise !== 'none')"
        ".map((r) => r.seed)).size"
    )
    assert [one["unit"] for one in curves] == ["m/s²", "rad/s"]
    assert [len(one["lines"]) for one in curves] == [noises, noises]


def test_the_values_at_the_cursor_are_those_of_the_rollouts(replay):
    told = replay.run(
        "(() => { const out = [], pen = strips.canvas.getContext('2d'), fill = pen.fillText;"
        " pen.fillText = (text) => out.push(text); strips.draw(2); delete pen.fillText;"
        " return out; })()"
    )
    shown = replay.run("visible().map((i) => rollouts[i].get('speed').data[20].toFixed(1))")
    assert len(shown) >= 4
    assert sorted(told[: len(shown)]) == sorted(shown)


def test_the_ego_drives_up_where_that_is_asked_for(replay):
    replay.press("u")
    replay.run("replay.seek(3)")
    heading = (
        "(([x, y, h], p) => [0, 5].map((d) =>"
        " p.toScreen(x + d * Math.cos(h), y + d * Math.sin(h))))"
        "(egoPose(state.focus, sampleAt(3)), panels[0].panel)"
    )
    (x, y), (ahead, above) = replay.run(heading)
    assert ahead == pytest.approx(x, abs=0.01)
    assert above < y - 10
    assert y > replay.run("canvas.clientHeight") / 2  # more is seen ahead than behind
    back = replay.run(f"panels[0].panel.toWorld({x}, {y})")
    assert back == pytest.approx(replay.run("egoPose(state.focus, sampleAt(3)).slice(0, 2)"))
    assert replay.run("state.follow")
    replay.press("f")
    assert not replay.run("state.up")


@pytest.mark.parametrize(("count", "wide", "across"), [(4, 1, 2), (6, 1, 3), (6, 0, 2), (3, 0, 1)])
def test_panels_stand_in_rows(replay, count, wide, across):
    assert replay.run(f"panelsAcross({count}, {'true' if wide else 'false'})") == across


@pytest.mark.parametrize("size", [(1440, 900), (800, 600), (390, 844)])
def test_every_part_fits_the_window(page, folder, size):
    page.open((folder / "replay" / f"fork-{page_name(VIOLATED)}").as_uri() + "#tube=1&t=2", size)
    assert page.run("document.documentElement.scrollWidth") <= size[0]
    assert page.run("canvas.clientHeight") >= 0.35 * size[1]


def test_a_page_with_everything_stays_small(folder):
    for page in (folder / "replay").iterdir():
        assert page.stat().st_size <= 150_000, page.name
