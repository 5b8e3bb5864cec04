"""Pictures of a report."""

import pytest
from made_runs import random_scores, write_run

from shiftsim.report.groups import read_groups

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def groups(tmp_path_factory):
    run = write_run(
        tmp_path_factory.mktemp("figures") / "run",
        planners=("alpha", "beta", "gamma"),
        noise=("none", "awgn-low", "awgn-high", "ou-mid"),
        seeds=(0, 1),
        score=random_scores(5),
        missing=[("gamma", "none", 0, "t1")],
    )
    return read_groups([run])


def drawn(groups, **options):
    from shiftsim.report.figures import figures

    return {figure.name: figure for figure in figures(groups, **options)}


def test_there_are_pictures_of_robustness_cities_and_metrics(groups):
    assert set(drawn(groups)) == {"robustness_made-up", "cities_made-up", "metrics_made-up"}


def test_a_withheld_score_is_not_drawn_and_a_partial_one_on_request(groups):
    def points(found):
        axes = found["cities_made-up"].drawn.axes[0]
        return {line.get_label() for line in axes.lines}

    assert {"alpha", "beta"} <= points(drawn(groups))
    assert "gamma" not in points(drawn(groups))
    assert "gamma (partial)" in points(drawn(groups, allow_partial=True))


def test_points_are_the_scores(groups):
    axes = drawn(groups)["metrics_made-up"].drawn.axes[0]
    heights = {line.get_label(): line.get_ydata()[0] for line in axes.lines}
    expected = next(g for g in groups if (g.planner, g.noise) == ("alpha", "none"))
    assert heights["alpha"] == pytest.approx(expected.estimate().mean)


def test_planners_differ_without_colour(groups):
    axes = drawn(groups)["robustness_made-up"].drawn.axes[0]
    styles = [(line.get_marker(), str(line.get_linestyle())) for line in axes.lines]
    solid = [style for style in styles if style[0] not in ("None", "", "_", "|")]
    assert len(set(solid)) == len(solid) >= 2


def test_every_picture_says_what_its_scores_are(groups):
    for figure in drawn(groups).values():
        text = figure.drawn._supxlabel.get_text()
        assert "thresholds nuplan" in text
        assert "metrics v1" in text
        assert "4 scenarios" in text


def test_the_same_picture_has_the_same_bytes(groups, tmp_path):
    files = []
    for name in "ab":
        (tmp_path / name).mkdir()
        files.append(drawn(groups)["cities_made-up"].save(tmp_path / name))
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize("ending", ["svg", "pdf"])
def test_pictures_can_be_saved_as_vectors(groups, tmp_path, ending):
    assert drawn(groups)["metrics_made-up"].save(tmp_path, ending).stat().st_size > 1000
