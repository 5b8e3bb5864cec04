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


def pandas_means(path):
    pandas = pytest.importorskip("pandas")
    means = pandas.read_parquet(path).groupby(["planner", "noise"])["cls"].mean()
    return dict(means.items())


def polars_means(path):
    polars = pytest.importorskip("polars")
    table = polars.read_parquet(path).group_by("planner", "noise").agg(polars.mean("cls"))
    return {row[:2]: row[2] for row in table.iter_rows()}


def duckdb_means(path):
    duckdb = pytest.importorskip("duckdb")
    query = f"select planner, noise, avg(cls) from '{path}' group by all"
    return {row[:2]: row[2] for row in duckdb.sql(query).fetchall()}


@pytest.mark.parametrize("means_of", [pandas_means, polars_means, duckdb_means])
def test_other_readers_give_the_same_means(clean_run, means_of):
    from shiftsim.report.scores import summary

    means = means_of(clean_run.path / "scores.parquet")
    rows = {(row["planner"], row["noise"]): row["mean"] for row in summary(clean_run)["scores"]}
    assert set(means) == set(rows)
    for labels, mean in rows.items():
        assert means[labels] == pytest.approx(mean["cls"], abs=1e-12)


@pytest.mark.parametrize("reader", ["pandas", "polars", "duckdb"])
def test_other_readers_open_rollouts(clean_run, reader):
    module = pytest.importorskip(reader)
    path = next((clean_run.path / "rollouts").glob("*.parquet"))
    expected = pq.read_table(path)
    if reader == "duckdb":
        table = module.sql(f"select * from '{path}'").to_arrow_table()
    else:
        table = module.read_parquet(path)
    assert [float(x) for x in table["x_m"].to_numpy()] == expected["x_m"].to_pylist()
    assert len(table["plan_dx_m"][0]) == len(expected["plan_dx_m"][0])


def test_grouping_with_arrow_gives_the_same_means(clean_run):
    from shiftsim.report.scores import summary

    table = pq.read_table(clean_run.path / "scores.parquet")
    means = table.group_by(["planner", "noise"]).aggregate([("cls", "mean")]).to_pylist()
    found = {(row["planner"], row["noise"]): row["cls_mean"] for row in means}
    for row in summary(clean_run)["scores"]:
        labels = (row["planner"], row["noise"])
        assert found[labels] == pytest.approx(row["mean"]["cls"], abs=1e-12)


def test_metrics_and_scores_join_on_the_key(clean_run):
    keys = ["planner", "noise", "seed", "token"]
    joined = clean_run.metrics.join(clean_run.scores.select([*keys, "cls"]), keys=keys)
    assert joined.num_rows == clean_run.metrics.num_rows
    assert joined["cls"].null_count == 0
