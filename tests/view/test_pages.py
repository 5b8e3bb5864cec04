import json
import re
from dataclasses import replace

import numpy as np
import pytest
from made_runs import write_run
from pages import sections, unpack
from stores import write_toy_store
from worlds import cruise_scenario, standing_tracks

import shiftsim
from shiftsim.data.store.reading import open_store
from shiftsim.errors import ConfigError, DataError
from shiftsim.planners.registry import load_planner
from shiftsim.report.words import task_of
from shiftsim.sim.loop import simulate
from shiftsim.view.build import (
    Choice,
    Gallery,
    galleries,
    list_page,
    page_name,
    write_site,
)
from shiftsim.view.page import MAX_ROLLOUTS, fill, json_text, replay_page
from shiftsim.view.scene import ShownRollout
from shiftsim.view.still import save_figure
from shiftsim.world.state import AgentKind

HOSTILE = "</script><script>alert(1)</script><!--&\u2028'\""


@pytest.fixture(scope="module")
def scenario():
    bare = cruise_scenario(iterations=41)
    poses = np.array([[40.0, 3.5, 0.1], [25.0, -4.0, 1.0]])
    kinds = [AgentKind.VEHICLE, AgentKind.PEDESTRIAN]
    return replace(bare, tracks=standing_tracks(len(bare.time_us), poses, kinds))


def shown(scenario, **settings):
    log = simulate(scenario, load_planner("constant-velocity"), **settings)
    return ShownRollout("constant-velocity", settings.get("noise", "none"), 0, log, 0.5)


def test_a_page_holds_the_rollout_to_a_centimetre(scenario):
    item = shown(scenario)

    found = sections(replay_page(scenario, [item]))

    origin = np.rint(
        (np.min(item.log.expert_ego[:, :2], axis=0) + np.max(item.log.expert_ego[:, :2], axis=0))
        / 2
    )
    ego = unpack(found["rollout0"])["ego.xy"][:, 0]
    np.testing.assert_allclose(ego + origin, item.log.ego[:, :2], atol=0.006)
    tracks = unpack(found["scene"])["tracks.xy"]
    np.testing.assert_allclose(tracks[0] + origin, [[40.0, 3.5], [25.0, -4.0]], atol=0.006)
    assert json.loads(found["meta"])["tracks"] == list(scenario.tracks.tokens)


def test_rollouts_share_the_recorded_tracks_and_carry_their_own_when_traffic_reacts(scenario):
    moving = replace(
        scenario, tracks=replace(scenario.tracks, velocities=scenario.tracks.velocities + 2.0)
    )
    recorded = sections(replay_page(moving, [shown(moving), shown(moving, noise="ou-high")]))
    reacting = sections(replay_page(moving, [shown(moving, traffic="reactive")]))

    assert "tracks.xy" in unpack(recorded["scene"])
    assert "tracks.xy" not in unpack(recorded["rollout0"])
    assert "tracks.xy" in unpack(reacting["rollout0"])
    assert "tracks.xy" not in unpack(reacting["scene"])


def permutations_of(paths, lines):
    """Each path with the line of every other one."""
    return ((p, q) for i, p in enumerate(paths) for j, q in enumerate(lines) if i != j)


def test_a_tube_lies_between_the_paths_of_seeds_also_of_other_pages(scenario):
    seeds = [replace(shown(scenario, noise="ou-high", seed=n), seed=n) for n in range(3)]
    page = sections(replay_page(scenario, seeds[:1], seeds=seeds))

    (tube,) = json.loads(page["meta"])["tubes"]
    fields = unpack(page["scene"])
    assert (tube["planner"], tube["noise"]) == ("constant-velocity", "ou-high")
    paths = np.array([item.log.ego[:, :2] for item in seeds])
    dense = np.linspace(0, 39, 4000)
    lines = [np.stack([np.interp(dense, range(40), p[:40, i]) for i in (0, 1)], 1) for p in paths]
    from_path = [
        np.hypot(*(line - path[20]).T).min() for path, line in permutations_of(paths, lines)
    ]
    assert fields["tube0.across"][20] == pytest.approx(max(from_path), abs=0.01)
    steps = np.hypot(*np.moveaxis(np.diff(paths[:, :21], axis=1), 2, 0)).sum(axis=1)
    assert fields["tube0.along"][20] == pytest.approx(np.ptp(steps), abs=0.02)
    assert np.ptp(fields["tube0.xy"][:, 1]) == pytest.approx(np.ptp(paths[:, :, 1]), abs=0.3)
    alone = sections(replay_page(scenario, seeds[:1]))
    assert json.loads(alone["meta"])["tubes"] == []


def test_making_a_page_leaves_rollout_and_scenario_as_they_are(scenario):
    item = shown(scenario)
    item.log.expert_ego[:, 2] += 7.0  # headings beyond a turn are unwrapped for the page only
    before = item.log.expert_ego.copy(), item.log.ego.copy(), scenario.tracks.poses.copy()

    replay_page(scenario, [item])

    for was, now in zip(
        before, (item.log.expert_ego, item.log.ego, scenario.tracks.poses), strict=True
    ):
        np.testing.assert_array_equal(was, now)


def test_texts_of_the_data_cannot_become_script(scenario):
    hostile = replace(
        scenario, token=HOSTILE, city=HOSTILE, scenario_type=HOSTILE, log_name=HOSTILE
    )
    item = replace(shown(scenario), planner=HOSTILE, noise=HOSTILE)

    page = replay_page(hostile, [item])

    assert "alert(1)</script>" not in page
    assert "<script>alert" not in page
    assert page.count("<script") == 4  # meta, scene, one rollout, the program
    assert json.loads(sections(page)["meta"])["token"] == HOSTILE
    assert json.loads(sections(page)["meta"])["rollouts"][0]["planner"] == HOSTILE


def test_the_list_escapes_what_it_shows():
    row = {"token": HOSTILE, "type": HOSTILE, "violated": {}, "page": page_name(HOSTILE)}
    row |= {"planner": HOSTILE, "noise": HOSTILE, "cls": None}

    page = list_page(HOSTILE, [row], shown=HOSTILE)

    assert "<script>alert" not in page
    assert page.count("<script") == 4  # rows, words of the metrics, looks, the program
    assert json.loads(sections(page)["rows"])[0]["token"] == HOSTILE


def test_a_page_needs_nothing_from_elsewhere(scenario):
    page = replay_page(scenario, [shown(scenario)])

    assert "default-src 'none'" in page
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!data:)""", page)
    assert "http://" not in page
    assert "https://" not in page


def test_file_names_of_pages_are_distinct_and_stay_in_their_folder():
    tokens = ["0123abcd", "../../etc/passwd", "a/b", "a~2fb", "A b", "ä", "con?x=1#y"]

    names = [page_name(token) for token in tokens]

    assert names[0] == "0123abcd.html"
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9_~-]+\.html", name) for name in names)


def test_a_template_is_filled_once():
    assert fill("<{{a}}|{{b}}>", a="{{b}}", b="{{a}}") == "<{{b}}|{{a}}>"


def test_json_for_a_page_has_no_markup():
    text = json_text({"a": "<b>&</b>\u2028"})

    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == {"a": "<b>&</b>\u2028"}


def test_a_page_in_a_notebook_is_a_frame_of_its_own(scenario):
    frame = replay_page(scenario, [shown(scenario)])._repr_html_()

    assert frame.count("<") == 2  # the frame's own tag, opened and closed
    assert 'sandbox="allow-scripts"' in frame


def test_rollouts_are_shown_by_name_and_in_notebooks(scenario, tmp_path):
    log = shown(scenario).log

    page = shiftsim.show(scenario, mine=log, pdm_closed=log)

    names = [item["planner"] for item in json.loads(sections(page)["meta"])["rollouts"]]
    assert names == ["mine", "pdm-closed"]
    assert page._repr_html_().startswith("<iframe")
    assert page.save(tmp_path / "a.html").read_text("utf-8") == page


def test_a_run_shows_the_replay_of_a_scenario(clean_run):
    page = clean_run.view("0001")

    assert json.loads(sections(page)["meta"])["token"] == "0001cafe"


def test_of_more_than_six_rollouts_the_first_are_drawn_and_the_page_says_so(scenario):
    page = replay_page(scenario, [shown(scenario)] * (MAX_ROLLOUTS + 1))

    meta = json.loads(sections(page)["meta"])
    assert meta["shown"] == "6 of 7 rollouts shown"
    assert len(meta["rollouts"]) == 6
    assert "rollout5" in sections(page)
    assert "rollout6" not in sections(page)
    with pytest.raises(ValueError, match="at least one"):
        replay_page(scenario, [])


def test_sixty_agents_take_less_than_the_promised_room(rng):
    bare = cruise_scenario()
    rows = len(bare.time_us)
    still = standing_tracks(rows, rng.uniform(0, 60, (60, 3)), [AgentKind.VEHICLE] * 60)
    wander = np.cumsum(rng.normal(0, 0.3, (rows, 60, 3)), axis=0)
    crowded = replace(bare, tracks=replace(still, poses=still.poses + wander))

    page = replay_page(crowded, [shown(crowded)])

    assert len(page) < 400_000


def test_four_rollouts_with_traffic_of_their_own_take_less_than_the_promised_room(rng):
    bare = cruise_scenario()
    still = standing_tracks(len(bare.time_us), rng.uniform(-60, 60, (60, 3)), [0] * 60)
    driven = np.cumsum(np.cumsum(rng.normal(0, 0.02, (len(bare.time_us), 60, 3)), axis=0), axis=0)
    crowded = replace(bare, tracks=replace(still, poses=still.poses + driven))
    items = []
    for number in range(4):
        item = shown(crowded, noise="ou-high", seed=number)
        tracks = item.log.tracks.copy()
        tracks.poses[40:, number] += np.cumsum(rng.normal(0, 0.1, tracks.poses[40:, 0].shape), 0)
        items.append(replace(item, log=replace(item.log, tracks=tracks)))

    page = replay_page(crowded, items)

    assert json.loads(sections(page)["meta"])["ownTracks"]
    assert len(page) < 150_000


@pytest.fixture
def gallery(clean_run, toy):
    return Gallery([clean_run], open_store(toy))


class TestGallery:
    def test_every_scenario_shows_each_planner_clean_and_with_every_seed(self, gallery):
        tasks = gallery.tasks(gallery.tokens[0])

        assert [(t.planner, t.noise, t.seed) for t in tasks] == [
            ("constant-velocity", "none", 0),
            ("constant-velocity", "ou-high", 0),
            ("constant-velocity", "ou-high", 1),
            ("log-future", "none", 0),
            ("log-future", "ou-high", 0),
            ("log-future", "ou-high", 1),
        ]
        assert gallery.shown_words(gallery.tokens[0]) == ""

    def test_the_choice_narrows_planners_noises_and_seeds(self, clean_run, toy):
        choice = Choice(planners=("log-future",), noises=("ou-high",), seeds=(1,))
        gallery = Gallery([clean_run], open_store(toy), choice)

        assert [t.seed for t in gallery.tasks(gallery.tokens[0])] == [1]
        words = "1 of 1 rollouts shown, only planner log-future, noise ou-high, seed 1"
        assert gallery.shown_words(gallery.tokens[0]) == words

    def test_what_exceeds_a_page_follows_on_others_the_lowest_scores_first(
        self, clean_run, gallery, tmp_path, monkeypatch
    ):
        monkeypatch.setattr("shiftsim.view.build.MAX_ROLLOUTS", 4)
        token = gallery.tokens[0]

        write_site(tmp_path, [gallery], title="toy")

        first, second = gallery.parts(token)
        cls = {task_of(row): row["cls"] for row in clean_run.scores.to_pylist()}
        assert max(cls[task] for task in first) <= min(cls[task] for task in second)
        metas = [
            json.loads(sections((tmp_path / "replay" / page_name(token, part)).read_text())["meta"])
            for part in (0, 1)
        ]
        assert [meta["shown"] for meta in metas] == [
            "4 of 6 rollouts shown",
            "2 of 6 rollouts shown",
        ]
        assert metas[0]["parts"] == [["1–4", page_name(token)], ["5–6", page_name(token, 1)]]
        rows = json.loads(sections((tmp_path / "index.html").read_text())["rows"])
        assert {task_of(row) for row in rows} == set(cls)
        for row in rows:  # each link leads to the page and the place of its rollout
            page = json.loads(sections((tmp_path / row["page"]).read_text())["meta"])
            assert page["rollouts"][row["index"]]["planner"] == row["planner"]
            assert page["rollouts"][row["index"]]["seed"] == row["seed"]

    def test_rollouts_that_failed_or_are_not_stored_are_listed_failures_first(self, tmp_path):
        lost = [("beta", "none", 0, f"t{number}") for number in range(4)]
        run = write_run(tmp_path / "run", planners=("alpha", "beta"), missing=lost)
        (gallery,) = galleries([run], [None], Choice())

        assert write_site(tmp_path / "site", [gallery], title="made") == 0

        page = (tmp_path / "site" / "index.html").read_text()
        rows = json.loads(sections(page)["rows"])
        assert [row["failed"] for row in rows] == ["failed", ""] * 4
        assert all(row["page"] is None for row in rows)
        assert "4 of 8 rollouts failed; 4 rollouts have no replay" in page

    def test_type_and_city_of_what_never_finished_come_from_the_store(self, tmp_path, toy):
        lost = [("alpha", "none", 0, "0001cafe")]
        run = write_run(tmp_path / "run", tokens=("0001cafe",), types=("",), missing=lost)
        run.manifest["determining"]["store"] = open_store(toy).hash

        (row,) = Gallery([run], open_store(toy)).rows("0001cafe")
        (alone,) = Gallery([run], None).rows("0001cafe")

        assert row["failed"]
        assert (row["type"], row["city"]) == ("parked", "straight")
        assert (alone["type"], alone["city"]) == ("", "")

    def test_a_page_and_a_list_say_what_they_leave_out(self, clean_run, toy, tmp_path):
        gallery = Gallery([clean_run], open_store(toy), Choice(seeds=(1,)))

        write_site(tmp_path, [gallery], title="toy", limit=1)

        page = (tmp_path / "index.html").read_text()
        assert "16 of 24 rollouts listed: only seed 1" in page
        assert "replays of 1 of 4 scenarios, the others with --limit 0" in page
        rows = json.loads(sections(page)["rows"])
        assert len({row["token"] for row in rows}) == 4  # also without a page
        assert {row["token"] for row in rows if "path" in row} == {gallery.tokens[0]}

    def test_a_folder_of_pages_links_every_rollout(self, gallery, tmp_path):
        count = write_site(tmp_path, [gallery], title="toy")

        rows = json.loads(sections((tmp_path / "index.html").read_text())["rows"])
        assert count == 4
        assert {row["page"] for row in rows} == {f"replay/{page_name(t)}" for t in gallery.tokens}
        assert all((tmp_path / row["page"]).is_file() for row in rows)
        lowest = min(rows, key=lambda row: row["cls"])
        assert rows[0]["token"] == lowest["token"]

    def test_an_unknown_scenario_is_named_with_a_near_one(self, gallery):
        with pytest.raises(ConfigError) as caught:
            gallery.find("0000cafd")

        assert "0000cafe" in caught.value.hint

    def test_the_beginning_of_a_token_is_enough(self, gallery):
        assert gallery.find("0003") == "0003cafe"

    def test_a_run_of_another_store_is_refused(self, clean_run, toy, tmp_path):
        other = open_store(write_toy_store(tmp_path / "other", count=1, first=7))

        with pytest.raises(DataError, match="another store"):
            Gallery([clean_run], other)


class TestFigures:
    @pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
    def test_stills_have_the_same_bytes_each_time(self, scenario, tmp_path, ending):
        pytest.importorskip("matplotlib")
        items = [shown(scenario), shown(scenario, noise="ou-high")]

        files = [tmp_path / f"{name}.{ending}" for name in "ab"]
        for file in files:
            save_figure(file, scenario, items, at=[1.0])

        assert files[0].read_bytes() == files[1].read_bytes()

    def test_an_unknown_ending_names_those_possible(self, scenario, tmp_path):
        with pytest.raises(ConfigError, match=r"\.bmp") as caught:
            save_figure(tmp_path / "a.bmp", scenario, [shown(scenario)], at=[0.0])

        assert ".svg" in caught.value.hint

    def test_a_time_beyond_the_end_is_refused(self, scenario, tmp_path):
        with pytest.raises(ConfigError, match="not within"):
            save_figure(tmp_path / "a.png", scenario, [shown(scenario)], at=[99.0])
