"""Results are plain Parquet: other tools read them as they lie."""

import pyarrow as pa
import pyarrow.compute
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest


def test_columns_have_plain_types(clean_run):
    plain = {pa.string(), pa.int64(), pa.float64()}
    for name in ("scores", "metrics", "tasks"):
        schema = pq.read_schema(clean_run.path / f"{name}.parquet")
        assert set(schema.types) <= plain, name


def test_runs_are_one_dataset(clean_run):
    pattern = sorted(clean_run.path.parent.glob("*/scores.parquet"))
    dataset = pyarrow.dataset.dataset(list(map(str, pattern)), format="parquet")
    chosen = dataset.to_table(filter=pyarrow.dataset.field("planner") == "log-future")
    own = clean_run.scores
    assert (
        chosen["cls"].to_pylist()
        == own.filter(pa.compute.equal(own["planner"], "log-future"))["cls"].to_pylist()
    )


def test_pandas_gives_the_same_means(clean_run):
    pandas = pytest.importorskip("pandas")
    from shiftsim.report import score_rows

    frame = pandas.read_parquet(clean_run.path / "scores.parquet")
    means = frame.groupby(["planner", "noise", "seed"])["cls"].mean()
    means = means.groupby(["planner", "noise"]).mean()
    for row in score_rows(clean_run):
        assert means[row.labels] == pytest.approx(row.means["cls"], abs=1e-12)


def test_grouping_with_arrow_gives_the_same_means(clean_run):
    from shiftsim.report import score_rows

    table = pq.read_table(clean_run.path / "scores.parquet")
    means = table.group_by(["planner", "noise"]).aggregate([("cls", "mean")]).to_pylist()
    found = {(row["planner"], row["noise"]): row["cls_mean"] for row in means}
    for row in score_rows(clean_run):
        assert found[row.labels] == pytest.approx(row.means["cls"], abs=1e-12)


def test_metrics_and_scores_join_on_the_key(clean_run):
    keys = ["planner", "noise", "seed", "token"]
    joined = clean_run.metrics.join(clean_run.scores.select([*keys, "cls"]), keys=keys)
    assert joined.num_rows == clean_run.metrics.num_rows
    assert joined["cls"].null_count == 0
