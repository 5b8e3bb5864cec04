"""Every block of every page runs as it stands; links, flags and tables of columns are right."""

import importlib.util
import inspect
import itertools
import json
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path
from textwrap import dedent
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from doc_pages import (
    PAGES,
    PLAIN,
    REPOSITORY,
    RUN,
    SHOWN,
    Block,
    Session,
    anchors,
    click_commands,
    links,
    parse_only,
    read_blocks,
    shiftsim_calls,
    table_below,
)
from open_data_files import write_commonroad
from track_files import table_of, write_demo, write_tracks

import shiftsim
from shiftsim.benchmarks import load_track
from shiftsim.data.readers.dsc3d import open_site
from shiftsim.data.store import map as store_map
from shiftsim.data.store import schema
from shiftsim.data.synthetic import store as synthetic
from shiftsim.metrics import MULTIPLIERS, PROFILES, SHORT_NAMES, WEIGHTS
from shiftsim.planners.registry import PLANNERS
from shiftsim.report.words import LONG, legend
from shiftsim.runs import config
from shiftsim.runs.tables import TABLES

DOCS = REPOSITORY / "docs"
BLOCKS = [block for page in PAGES for block in read_blocks(page)]
MOST_NOT_RUN = 10
EXAMPLE = re.compile(r"Example:\n +```python\n(.*?)\n +```", re.S)
NEEDS = {  # of extras and of the dependency group `docs`
    **dict.fromkeys(("README", "index", "learned_planners"), ("torch", "safetensors")),
    "nuplan_results": ("msgpack",),
    "training": ("gymnasium", "torch", "safetensors"),
    **dict.fromkeys(("run_folder", "store_format"), ("duckdb", "pandas", "polars")),
    **dict.fromkeys(
        ("compare_checkpoints", "quickstart", "sensor_drift", "state_drift"), ("matplotlib",)
    ),
    "seeing": ("matplotlib", "pandas"),
}
UNITS = {
    "_us": "µs",
    "_s": "s",
    "_m": "m",
    "_rad": "rad",
    "_mps": "m/s",
    "_mps2": "m/s²",
    "_radps": "rad/s",
    "_radps2": "rad/s²",
    "_seconds": "s",
    "_ms_mean": "ms",
    "_ms_p95": "ms",
}
TYPES = {
    pa.string(): "string",
    pa.float64(): "float64",
    pa.float32(): "float32",
    pa.int64(): "int64",
    pa.int32(): "int32",
    pa.int8(): "int8",
    pa.bool_(): "bool",
}


# --- what a reader has at hand


@pytest.fixture(scope="session")
def material(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo store, recordings, logs, tables and maps that the pages speak of."""
    folder = tmp_path_factory.mktemp("material")
    write_demo(folder / "towns")
    synthetic.demo_store(folder / "shiftsim-data" / "demo")
    (folder / "dsc3d").mkdir()
    (folder / "towns" / "junction").rename(folder / "dsc3d" / "sindelfingen")
    _write_tracks(folder, folder / "towns" / "parking")
    shutil.rmtree(folder / "towns")
    golden = REPOSITORY / "tests" / "golden" / "nuplan_format"
    for name in ("logs", "maps"):
        shutil.copytree(golden / name, folder / "nuplan" / name)
    write_commonroad(folder / "commonroad")
    _write_results(folder, golden.parent)
    if importlib.util.find_spec("torch"):
        from checkpoint_files import state_of, write_published

        made = write_published(folder / "downloads", "plantf", state_of("plantf"))
        made.rename(made.with_name("planTF.ckpt"))
    return folder


def _write_results(folder: Path, golden: Path) -> None:
    """A result folder of nuPlan, and the scenes it is about; for docs/nuplan_results.md."""
    shutil.copytree(golden / "nuplan_experiment", folder / "exp")
    report = pq.read_table(next((folder / "exp").rglob("runner_report.parquet")))
    (folder / "tokens.txt").write_text("\n".join(report["scenario_name"].to_pylist()))
    logs = {f"{name}.db" for name in report["log_name"].to_pylist()}
    with tarfile.open(golden / "nuplan.tar.xz") as archive:
        for member in archive.getmembers():
            _, _, member.name = member.name.partition("/")
            if member.name.startswith("maps/") or Path(member.name).name in logs:
                archive.extract(member, folder / "scenes")


def _write_tracks(folder: Path, recording: Path) -> None:
    """A CSV and a map of docs/own_scenarios.md."""
    columns, map_path = table_of(open_site(recording))
    (folder / "map.xodr").write_bytes(map_path.read_bytes())
    write_tracks(folder / "tracks.csv", columns, frame=None)


@pytest.fixture
def desk(material: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with that material; what a page imports is forgotten afterwards."""
    shutil.copytree(material, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SHIFTSIM_DATA", raising=False)
    monkeypatch.setenv("SHIFTSIM_CHECKPOINTS", str(tmp_path / "checkpoints"))
    monkeypatch.setenv("SHIFTSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setattr(config, "_cores", lambda: 1)  # no worker processes: kernels stay warm
    before, search, finders = set(sys.modules), list(sys.path), list(sys.meta_path)
    yield tmp_path
    sys.path[:], sys.meta_path[:] = search, finders
    for name in set(sys.modules) - before:
        file = str(getattr(sys.modules[name], "__file__", None) or "")
        if file.startswith(str(tmp_path)) or name.partition(".")[0] == "nuplan":
            del sys.modules[name]


# --- blocks


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_runs_as_it_stands(page: Path, desk: Path) -> None:
    for module in NEEDS.get(page.stem, ()):
        pytest.importorskip(module)
    session = Session()
    for block in read_blocks(page):
        if not block.reason and (block.kind in (*RUN, *SHOWN) or block.file):
            session.do(block)


@pytest.mark.thorough
def test_the_example_of_every_public_name_runs(desk: Path) -> None:
    for name in ("run", "Run", *shiftsim.__all__):  # `Run` writes what `open_run` reads
        found = EXAMPLE.search(inspect.getdoc(getattr(shiftsim, name)) or "")
        assert found, name
        exec(dedent(found[1]), {"shiftsim": shiftsim})


def test_tracks_and_a_map_become_scores_in_fifty_lines() -> None:
    (code,) = (b for b in BLOCKS if b.page == "own_scenarios.md" and b.kind == "python")
    assert len(code.text.splitlines()) <= 50


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_says_what_it_is(page: Path) -> None:
    kinds = {block.kind for block in read_blocks(page)}
    assert kinds <= {*RUN, *SHOWN, *PLAIN}


def test_few_blocks_are_not_run_and_those_parse(capsys: pytest.CaptureFixture[str]) -> None:
    idle = [block for block in BLOCKS if block.reason]
    for block in idle:
        if block.kind == "sh":
            _parse(block)
        elif block.kind == "python":
            compile(block.text, block.where, "exec")
    counted = [block for block in BLOCKS if block.kind in RUN]
    with capsys.disabled():
        print(f"\n{len(idle)} of {len(counted)} blocks of the documentation are not run:")
        for block in idle:
            print(f"  {block.where}: {block.reason}")
    assert len(idle) <= MOST_NOT_RUN


def _parse(block: Block) -> None:
    targets = re.findall(r"^([\w-]+):", (REPOSITORY / "Makefile").read_text(), flags=re.M)
    for line in block.commands:
        words = line.split()
        if words[0] == "make":
            assert words[1] in targets, f"{block.where}: make {words[1]}"
        for call in shiftsim_calls(line):
            try:
                parse_only(call)
            except Exception as error:
                raise AssertionError(f"{block.where}: {line}: {error}") from error


def test_blocks_that_install_name_extras_that_exist() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    extras = set(project["project"]["optional-dependencies"])
    text = "".join(page.read_text("utf-8") for page in PAGES)
    found = re.findall(r"(?:shiftsim|\.)\[([\w,]+)\]", text)
    named = {name for names in found for name in names.split(",")}
    assert named
    assert named <= extras


# --- commands and flags


def test_every_command_is_in_the_documentation() -> None:
    called = set()
    for block in BLOCKS:
        for line in block.commands if block.kind == "sh" else ():
            called |= {parse_only([*call, *block.words]) for call in shiftsim_calls(line)}
    leaves = {
        words for words, command in click_commands().items() if not hasattr(command, "commands")
    }
    assert sorted(leaves - called) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_flags_in_the_text_exist(page: Path) -> None:
    commands = click_commands().values()
    known = {name for command in commands for option in command.params for name in option.opts}
    known |= {name for command in commands for one in command.params for name in one.secondary_opts}
    known |= {"--help"}
    prose = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.M | re.S)
    said = {
        flag
        for code in re.findall(r"`([^`\n]+)`", prose)
        for flag in re.findall(r"(?<![\w-])--[a-z][\w-]*", code)
    }
    foreign = {"--array", "--gres"}  # of SLURM
    assert sorted(said - known - foreign) == []


# --- links


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path) -> None:
    for link in links(page):
        name, _, anchor = link.partition("#")
        if re.match(r"[a-z]+:", link):
            continue
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), f"{page.name}: {link}"
        if anchor:
            assert anchor in anchors(target), f"{page.name}: {link}"


def test_every_page_is_in_the_index_and_in_the_navigation() -> None:
    pages = {str(page.relative_to(DOCS)) for page in PAGES if DOCS in page.parents}
    found = re.findall(r"([\w./]+\.md)$", (REPOSITORY / "mkdocs.yml").read_text(), re.M)
    linked = {
        link.partition("#")[0] for name in ("index", "api") for link in links(DOCS / f"{name}.md")
    }
    assert linked >= pages - {"index.md"}
    assert sorted(found) == sorted(pages)


def test_every_public_name_is_on_one_page_of_the_api_and_in_its_list() -> None:
    pages = sorted((DOCS / "api").glob("*.md"))
    found = {f"api/{page.name}": _documented(page) for page in pages}
    described = [name for names in found.values() for name in names]
    assert len(described) == len(set(described))
    public = {f"shiftsim.{name}" for name in shiftsim.__all__}
    assert set(described) >= public
    listed = {}
    for page, names in table_below(DOCS / "api.md", "## Pages"):
        listed[re.findall(r"\((.*)\)", page)[0]] = names.split(", ")
    assert listed == {page: [n.rpartition(".")[2] for n in names] for page, names in found.items()}


def _documented(page: Path) -> list[str]:
    return re.findall(r"^::: ([\w.]+)$", page.read_text("utf-8"), re.M)


# --- tables that say what the code says


def _unit(column: str) -> str:
    endings = (ending for ending in sorted(UNITS, key=len, reverse=True) if column.endswith(ending))
    return UNITS.get(next(endings, ""), "")


def _described(table: pa.Schema) -> list[list[str]]:
    out = []
    for column in table:
        is_list = pa.types.is_list(column.type)
        kind = column.type.value_type if is_list else column.type
        is_row = pa.types.is_fixed_size_list(kind)
        name = f"{kind.list_size} {TYPES[kind.value_type]}" if is_row else TYPES[kind]
        out.append([column.name, f"list of {name}" if is_list else name, _unit(column.name)])
    return out


STORE_TABLES = {
    "### scenarios.parquet": schema.SCENARIOS,
    "### frames.parquet": schema.FRAMES,
    "### lights.parquet": schema.LIGHTS,
    "### tracks.parquet": schema.TRACKS,
    "### ego-NAME.parquet": schema.EGO,
}
RUN_TABLES = {f"### {name}.parquet": table for name, table in TABLES.items()}


@pytest.mark.parametrize(
    ("page", "heading", "table"),
    [
        *((DOCS / "store_format.md", *item) for item in STORE_TABLES.items()),
        *((DOCS / "run_folder.md", *item) for item in RUN_TABLES.items()),
    ],
    ids=[*STORE_TABLES, *RUN_TABLES],
)
def test_column_tables_are_those_of_the_files(page: Path, heading: str, table: pa.Schema) -> None:
    assert [row[:3] for row in table_below(page, heading)] == _described(table)


def test_verdicts_of_the_filter_are_described() -> None:
    from shiftsim.runs.filter import SCHEMA

    rows = table_below(DOCS / "store_format.md", "### filter/verdicts.parquet")
    assert [row[:3] for row in rows] == _described(SCHEMA)


def test_columns_of_a_map_are_those_of_the_file() -> None:
    rows = table_below(DOCS / "store_format.md", "### maps/CITY.arrow")
    found = [
        ["".join(parts), kind]
        for columns, kind, *_ in rows
        for parts in itertools.product(
            *(piece.strip("{}").split(", ") for piece in re.findall(r"\{[^}]*\}|[^{]+", columns))
        )
    ]
    expected = [[name, kind] for name, kind, _ in _described(store_map.SCHEMA)]
    assert sorted(found) == sorted(expected)


@pytest.mark.thorough
def test_columns_of_a_rollout_are_those_of_the_file(desk: Path) -> None:
    import shiftsim

    split = {"store": "demo", "split": "demo-mini", "limit": 1, "workers": 1}
    run = shiftsim.run("log-future", traffic="reactive", out="run", **split)
    (path,) = (run.path / "rollouts").iterdir()
    table = pa.parquet.read_schema(path)
    plain = pa.schema(
        [(c.name, c.type.value_type if pa.types.is_dictionary(c.type) else c.type) for c in table]
    )
    rows = table_below(DOCS / "run_folder.md", "### rollouts/")
    assert [row[:3] for row in rows] == _described(plain)


def test_thresholds_are_those_of_the_profiles() -> None:
    rows = table_below(DOCS / "metrics.md", "## Thresholds")
    names = [name for name in PROFILES["nuplan"].__dataclass_fields__ if name != "name"]
    expected = [
        [name, *(f"{getattr(PROFILES[profile], name):g}" for profile in ("nuplan", "deepplan"))]
        for name in names
    ]
    assert [row[:3] for row in rows] == expected


def test_weights_are_those_of_the_score() -> None:
    rows = table_below(DOCS / "metrics.md", "## The score")
    roles: dict[str, Any] = dict.fromkeys(MULTIPLIERS, "factor")
    roles |= {name: f"weight {weight:g}" for name, weight in WEIGHTS.items()}
    assert [row[:3] for row in rows] == [[SHORT_NAMES[n], n, role] for n, role in roles.items()]


README = REPOSITORY / "README.md"
README_COLUMNS = ["CLS", "DAC"]


def test_columns_of_the_readme_have_the_names_of_all_tables() -> None:
    text = " ".join(README.read_text("utf-8").split())
    assert f"| planner | noise | {' | '.join(README_COLUMNS)} |" in text
    assert f"Two of nine columns: {legend(README_COLUMNS)}." in text
    assert len(LONG) == 9


@pytest.mark.thorough
@pytest.mark.slow
def test_numbers_of_the_readme_are_those_of_the_demo(desk: Path) -> None:
    run = shiftsim.demo(out="whole")
    lines = [line for line in str(run.table(format="md")).splitlines() if line.startswith("| ")]
    head, _, *rows = [[cell.strip() for cell in line[1:-1].split("|")] for line in lines]
    printed = [
        [row[0], row[1], *(row[head.index(name)] for name in README_COLUMNS)] for row in rows
    ]
    assert table_below(README, "The first command prints:\n") == printed


def test_badges_of_the_readme_are_true() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    versions = re.findall(r"Python :: (3\.\d+)", " ".join(project["project"]["classifiers"]))
    badges = re.findall(r"^!\[(.*)\]\(https://img\.shields\.io", README.read_text("utf-8"), re.M)
    assert badges == [
        f"Python {', '.join(versions)}",
        f"Licence {project['project']['license']}",
        "Typed: mypy strict",
    ]
    assert project["tool"]["mypy"]["strict"]


def test_checkpoints_are_those_of_the_planners() -> None:
    rows = table_below(DOCS / "learned_planners.md", "## Which file")
    expected = [
        [entry.name, entry.checkpoint.project, entry.checkpoint.file, entry.checkpoint.name]
        for entry in PLANNERS.values()
        if entry.checkpoint
    ]
    assert sorted([*row[:3], row[4]] for row in rows) == sorted(expected)


def test_the_planning_arithmetic_adds_up() -> None:
    *rows, total = table_below(DOCS / "reproducing.md", "### An example")
    rollouts = 2_300 * load_track("state-drift").rollouts_per_scenario
    hours = [rollouts / 2 * (float(row[1]) + float(row[2])) / 3600 for row in rows]
    expected = [*((rollouts, each) for each in hours), (len(rows) * rollouts, sum(hours))]
    found = [[cell.replace(",", "") for cell in row[3:]] for row in (*rows, total)]
    assert found == [[str(count), f"{each:.0f}"] for count, each in expected]
    text = (DOCS / "reproducing.md").read_text("utf-8")
    assert f"{sum(hours) / 64:.1f} hours on 64 cores" in text
    assert f"{sum(hours) / 48:.0f} days on two" in text


# --- the site


@pytest.mark.thorough
def test_the_site_is_built_without_a_warning() -> None:
    pytest.importorskip("zensical", reason="needs the dependency group `docs`")
    site = REPOSITORY / "build" / "tested"
    command = [sys.executable, "tools/build_site.py", str(site.relative_to(REPOSITORY))]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    for page in DOCS.rglob("*.md"):
        assert (site / page.relative_to(DOCS).with_suffix(".html")).is_file()
    found = json.loads((site / "search.json").read_text())["items"]
    pages = {item["location"].partition("#")[0] for item in found}
    assert {"metrics.html", "api/run.html"} <= pages
    assert "nuplan_rules.html" not in pages  # it has a filter of its own
    assert f"shiftsim {shiftsim.__version__}" in (site / "index.html").read_text()
    shutil.rmtree(site)
