"""Pictures of a report."""

import numpy as np
import pytest
from made_runs import random_scores, write_run
from pictures import cut_off, overlaps, sizes_in_pdf, smallest, written

from shiftsim.report import palette
from shiftsim.report.build import write_report
from shiftsim.report.groups import read_groups
from shiftsim.report.palette import FigureFormat, planner_styles
from shiftsim.report.words import LONG
from shiftsim.train import folder

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(
        tmp_path_factory.mktemp("figures") / "run",
        planners=("alpha", "beta", "gamma"),
        noise=("none", "awgn-low", "awgn-high", "ou-mid"),
        seeds=(0, 1),
        score=random_scores(5),
        missing=[("gamma", "none", 0, "t1")],
    )


@pytest.fixture(scope="module")
def groups(run):
    return read_groups([run])


def drawn(groups, **form):
    from shiftsim.report.figures import figures

    return {figure.name: figure for figure in figures(groups, form=FigureFormat.of(**form))}


def test_there_are_pictures_of_robustness_cities_and_metrics(groups):
    assert set(drawn(groups)) == {"robustness_made-up", "cities_made-up", "metrics_made-up"}


@pytest.mark.thorough
def test_a_withheld_score_is_not_drawn_and_a_partial_one_on_request(run, groups):
    def points(found):
        axes = found["cities_made-up"].drawn.axes[0]
        return {line.get_label() for line in axes.lines}

    assert {"alpha", "beta"} <= points(drawn(groups))
    assert "gamma" not in points(drawn(groups))
    assert "gamma (partial)" in points(drawn(read_groups([run], allow_partial=True)))


def test_points_are_the_scores(groups):
    axes = drawn(groups)["metrics_made-up"].drawn.axes[0]
    heights = {line.get_label(): line.get_ydata()[0] for line in axes.lines}
    expected = next(g for g in groups if (g.planner, g.noise) == ("alpha", "none"))
    assert heights["alpha"] == pytest.approx(expected.estimate().value)


def test_planners_differ_without_colour(groups):
    axes = drawn(groups)["robustness_made-up"].drawn.axes[0]
    styles = [(line.get_marker(), str(line.get_linestyle())) for line in axes.lines]
    solid = [style for style in styles if style[0] not in ("None", "", "_", "|")]
    assert len(set(solid)) == len(solid) >= 2


def test_every_picture_says_what_its_scores_are(groups):
    for figure in drawn(groups).values():
        text = " ".join(figure.drawn._supxlabel.get_text().split())
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


PAPER = ("carl", "pdm-closed", "pluto", "diffusion-planner", "plantf", "log-future")
OWN = tuple(f"my_package.my_module_{number}:MyFavouritePlanner" for number in range(5))
LEVELS = ("low", "mid", "high")
ALL = ("none", *(f"{kind}-{level}" for kind in ("awgn", "ou") for level in LEVELS))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("names", "noise", "split"),
    [(PAPER, ALL, "deepplan"), (OWN, ("none", "ou-low"), "a-split-with-quite-a-long-name-indeed")],
)
def test_words_neither_cover_one_another_nor_leave_the_picture(tmp_path, names, noise, split):
    cities = ("Sindelfingen", "San Francisco", "Stuttgart", "Munich")
    settings = {"planners": names, "noise": noise, "cities": cities, "split": split}
    runs = [
        write_run(tmp_path / traffic, traffic=traffic, **settings)
        for traffic in ("nonreactive", "reactive")
    ]
    for name, figure in drawn(read_groups(runs)).items():
        assert {*names} <= {text for text, _ in written(figure.drawn)}, name
        assert overlaps(figure.drawn) == [], name
        assert cut_off(figure.drawn) == [], name


def test_axes_are_labelled(groups):
    for figure in drawn(groups).values():
        assert all(axes.get_ylabel().endswith("score × 100") for axes in figure.drawn.axes[:1])
    robustness = drawn(groups)["robustness_made-up"].drawn
    assert {axes.get_xlabel() for axes in robustness.axes} == {"strength of the noise"}


def test_panels_of_drifts_have_axes_of_their_own(tmp_path):
    noise = "none", "perception-low", "miss-high", "localization-mid", "latency-100", "latency-300"
    pictures = drawn(read_groups([write_run(tmp_path / "run", noise=noise)]))
    boxes, times = (pictures[f"{kind}_made-up"].drawn for kind in ("perception", "latency"))
    assert [axes.get_xlabel() for axes in boxes.axes] == [
        "errors of the boxes",
        "missed detections",
    ]
    pose, late = times.axes
    assert pose.get_xlabel() == "error of the pose"
    assert late.get_xlabel() == "latency of the plans [ms]"
    assert [text.get_text() for text in late.get_xticklabels()] == ["0", "100", "300"]
    assert {"clean", "under drift"} <= {text for text, _ in written(times)}


def test_metrics_stand_in_the_order_of_all_tables_with_words_first(groups):
    axes = drawn(groups)["metrics_made-up"].drawn.axes[0]
    headings = [label.get_text().replace("\n", " ") for label in axes.get_xticklabels()]
    assert headings == [f"{words} ({short})" for short, words in LONG.items()]


def test_clean_is_full_and_solid_and_noise_hollow_and_dashed(groups):
    colour = planner_styles(["alpha", "beta", "gamma"])["alpha"].colour
    axes = drawn(groups)["robustness_made-up"].drawn.axes[0]
    mine = [line for line in axes.lines if line.get_color() == colour]
    faces = {
        (np.isfinite(line.get_ydata()).sum(), line.get_linestyle(), line.get_markerfacecolor())
        for line in mine
        if line.get_marker() not in ("None", "", "_", "|")
    }
    assert faces == {(1, "None", colour), (3, "--", "white")}
    (thin,) = [line for line in mine if line.get_linestyle() == "-" and len(line.get_xdata()) == 2]
    assert thin.get_ydata()[0] == pytest.approx(groups[0].estimate().value)


@pytest.mark.thorough
def test_a_report_in_latex_holds_the_pictures_as_pdf(groups, tmp_path):
    figures = [*drawn(groups).values()]
    write_report(tmp_path, "made up", [groups[0].run], [], figures, ["latex"])
    text = (tmp_path / "report.tex").read_text("utf-8")
    for figure in figures:
        assert f"\\includegraphics[width=\\linewidth]{{{figure.name}.pdf}}" in text
        assert (tmp_path / f"{figure.name}.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.thorough
def test_fonts_of_a_pdf_are_truetype_as_papers_ask_for(groups, tmp_path):
    content = drawn(groups)["metrics_made-up"].save(tmp_path, "pdf").read_bytes()
    assert b"/Type3" not in content
    assert b"/CIDFontType2" in content


def test_the_curve_of_a_training_is_drawn_in_the_colours_of_all_pictures(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(palette, "save_picture", lambda figure, path: kept.append(figure))
    rows = [{"samples": 1e5 * i, "acceleration_error": 0.2, "steering_error": 0.1} for i in (1, 2)]
    folder.draw_curves(tmp_path / "a.png", rows, [{"samples": 1e5, "none": 0.9, "ou-high": 0.7}])
    (figure,) = kept
    looks = [(line.get_color(), line.get_linestyle()) for line in figure.axes[1].lines]
    colour = planner_styles(["carl"])["carl"].colour
    assert looks == [(colour, "-"), (colour, "--")]
    assert overlaps(figure) == []
    assert cut_off(figure) == []


@pytest.mark.parametrize("width", ["3.5in", "7in"])
@pytest.mark.thorough
def test_letters_can_be_read_at_the_width_of_a_paper(tmp_path, width):
    groups = read_groups([write_run(tmp_path / "run", planners=PAPER, noise=ALL)])
    for name, figure in drawn(groups, width=width, serif=True, plain=True).items():
        sizes, found = sizes_in_pdf(figure.save(tmp_path, "pdf"))
        assert found == pytest.approx(float(width[:-2]), abs=0.01), name
        assert min(sizes) >= 7.0, name
        assert smallest(figure.drawn) >= 7.0, name
        assert cut_off(figure.drawn) == [], name
        assert overlaps(figure.drawn) == [], name


def test_a_plain_figure_leaves_title_and_notes_to_the_caption(groups):
    for figure in drawn(groups, plain=True).values():
        words = [text for text, _ in written(figure.drawn)]
        assert not any("made-up" in text or "bars:" in text for text in words)
        assert any("closed-loop score" in text or "score ×" in text for text in words)
        assert any("non-reactive" in text.lower() for text in words)  # no caption says of which
        assert figure.caption.startswith(f"{figure.title}: ")
        assert "bars: " in figure.caption
        assert figure.caption.count("made-up") == 1
    assert all(figure.caption == figure.title for figure in drawn(groups).values())


def test_no_line_leads_over_a_level_that_was_not_run(groups):
    white, correlated = drawn(groups)["robustness_made-up"].drawn.axes
    gaps = {
        tuple(np.isfinite(line.get_ydata()).tolist())
        for axes in (white, correlated)
        for line in axes.lines
        if line.get_linestyle() == "--"
    }
    assert (True, True, False, True) in gaps  # white noise at none, low and high
    assert (True, False, True, False) in gaps  # correlated noise at none and mid


def test_intervals_stay_within_what_scores_can_be(tmp_path):
    def score(planner, noise, seed, number):
        return float(seed)  # a deviation of 70 around 50

    settings = {"noise": ("none", "ou-high"), "seeds": (0, 1), "score": score}
    figure = drawn(read_groups([write_run(tmp_path / "run", **settings)]))["robustness_made-up"]
    (axes,) = figure.drawn.axes
    ends = [
        y for bars in axes.collections for path in bars.get_paths() for y in path.vertices[:, 1]
    ]
    assert (min(ends), max(ends)) == (0.0, 100.0)


@pytest.mark.thorough
def test_names_stand_at_the_ends_of_lines_where_they_find_room(tmp_path):
    for names, is_direct in ((PAPER, True), (OWN, False)):
        groups = read_groups([write_run(tmp_path / names[0], planners=names, noise=ALL)])
        figure = drawn(groups)["robustness_made-up"].drawn
        (legend,) = figure.legends
        in_legend = {text.get_text() for text in legend.get_texts()}
        named = {text.get_text() for axes in figure.axes for text in axes.texts}
        assert (named == {*names}) is is_direct
        assert ({*names} <= in_legend) is not is_direct


def test_names_with_dollars_are_no_mathematics(tmp_path):
    from matplotlib.text import Text

    for figure in drawn(read_groups([write_run(tmp_path / "a", planners=("a$x$b",))])).values():
        assert not any(
            text.get_parse_math() for text in figure.drawn.findobj(Text) if text.get_text()
        )
