"""Workflows, forms and tools of the project name what exists, and grant no more than they need."""

import importlib.util
import re
import subprocess
import sys
import tomllib

import pytest
import yaml
from places import REPOSITORY

GITHUB = REPOSITORY / ".github"
WORKFLOWS = sorted((GITHUB / "workflows").glob("*.yml"))
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
TARGETS = set(re.findall(r"^([\w-]+):", (REPOSITORY / "Makefile").read_text(), re.M))
PINNED = re.compile(r"^ *-? *(?:- )?uses: [\w-]+(?:/[\w-]+)+@[0-9a-f]{40} # v\d+\.\d+\.\d+\b", re.M)
MADE = {"dist", "build", ".venv"}  # by the commands of a workflow
MAY_WRITE = {("docs.yml", "deploy"), ("release.yml", "publish")}

by_workflow = pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)


def read(path):
    return yaml.safe_load(path.read_text("utf-8"))


def steps(path):
    return [step for job in read(path)["jobs"].values() for step in job["steps"]]


@by_workflow
def test_commands_of_a_workflow_name_targets_and_files_that_exist(path):
    lines = [line for step in steps(path) for line in step.get("run", "").splitlines()]
    for line in lines:
        words = re.sub(r"\$\{\{.*?\}\}", "", line.partition(" #")[0]).split()
        if words[0] == "make":
            assert {word for word in words[1:] if "=" not in word} <= TARGETS
        for word in words:
            if re.fullmatch(r"[\w.-]+(/[\w.-]+)+|[\w-]+\.(py|toml|txt|md)", word):
                assert word.split("/")[0] in MADE or (REPOSITORY / word).exists(), word


def test_scripts_and_targets_of_other_files_exist():
    called = re.findall(r"^(?:exec )?make ([\w-]+)", (REPOSITORY / ".ci/run").read_text(), re.M)
    assert called
    assert set(called) <= TARGETS
    for name in re.findall(r"(?:tools|tests)/[\w./]+", (REPOSITORY / "Makefile").read_text()):
        assert (REPOSITORY / name).exists(), name


def test_make_reads_every_target():
    command = ["make", "--dry-run", "--warn-undefined-variables", *sorted(TARGETS - {".venv"})]
    answer = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)
    assert (answer.returncode, answer.stderr) == (0, "")


@by_workflow
def test_every_action_is_pinned_by_the_hash_of_a_commit(path):
    used = [step["uses"] for step in steps(path) if "uses" in step]
    assert used
    assert len(PINNED.findall(path.read_text())) == len(used)


@by_workflow
def test_a_workflow_reads_only_unless_it_publishes(path):
    workflow = read(path)
    assert workflow["permissions"] == {"contents": "read"}
    assert workflow["concurrency"]["group"]
    granted = {name for name, job in workflow["jobs"].items() if "permissions" in job}
    assert {(path.name, name) for name in granted} <= MAY_WRITE
    for job in workflow["jobs"].values():
        assert job["timeout-minutes"] <= 60
        assert set(needed(job)) <= set(workflow["jobs"])
    for step in steps(path):
        if step.get("uses", "").startswith("actions/checkout@"):
            assert step["with"]["persist-credentials"] is False


def needed(job):
    found = job.get("needs", [])
    return [found] if isinstance(found, str) else found


def test_the_versions_of_python_are_tested():
    versions = re.findall(r"Python :: (3\.\d+)", " ".join(PROJECT["classifiers"]))
    assert read(GITHUB / "workflows/ci.yml")["jobs"]["checks"]["strategy"]["matrix"] == {
        "python": versions
    }


def test_forms_and_updates_are_complete():
    for path in (GITHUB / "ISSUE_TEMPLATE").glob("*.yml"):
        form = read(path)
        if path.name != "config.yml":
            ids = [field["id"] for field in form["body"]]
            assert len(ids) == len(set(ids)) > 0
            assert form["name"]
            assert form["description"]
    updates = read(GITHUB / "dependabot.yml")["updates"]
    assert {entry["package-ecosystem"] for entry in updates} == {"github-actions", "pip"}
    for name in re.findall(r"`make ([\w -]+)`", (GITHUB / "pull_request_template.md").read_text()):
        assert set(name.split()) <= TARGETS


def test_the_citation_is_of_this_version():
    citation = read(REPOSITORY / "CITATION.cff")
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]


def test_the_oldest_packages_are_those_that_the_project_allows():
    command = [sys.executable, "tools/lowest.py"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    found = done.stdout.split()
    assert "numba>=0.62,==0.62.*" in found
    assert "torch>=2.6,==2.6.*" in found
    assert len(found) > len(PROJECT["dependencies"])


@pytest.fixture
def api_diff(monkeypatch):
    pytest.importorskip("griffe", reason="needs the dependency group `docs`")
    monkeypatch.syspath_prepend(str(REPOSITORY / "tools"))
    path = REPOSITORY / "tools" / "api_diff.py"
    spec = importlib.util.spec_from_file_location("api_diff", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def write_package(tree, signature):
    """A package with one public function, defined in a folder without `__init__.py`."""
    folder = tree / "shiftsim" / "api"
    folder.mkdir(parents=True)
    (folder / "made.py").write_text(
        f"def drive({signature}):\n    pass\n\n\ndef helper():\n    pass\n"
    )
    source = (
        '"""A package."""\n\nfrom shiftsim.api.made import drive as drive\n\n__all__ = ["drive"]\n'
    )
    (folder.parent / "__init__.py").write_text(source)


def test_a_changed_public_signature_is_noticed(api_diff, tmp_path):
    found = {}
    for name, signature in (("old", "planner, noise=0"), ("more", "planner, noise=0, seed=0")):
        write_package(tmp_path / name, signature)
        found[name] = api_diff.load(tmp_path / name, tmp_path / f"copy-{name}")
    write_package(tmp_path / "less", "planner")
    less = api_diff.load(tmp_path / "less", tmp_path / "copy-less")
    assert list(api_diff.changes(found["old"], found["more"])) == []
    (change,) = api_diff.changes(found["old"], less)
    assert "noise" in change


def test_every_change_has_a_kind_that_the_changelog_knows():
    tool = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["towncrier"]
    names = {path.name for path in (REPOSITORY / "changes").iterdir()} - set(tool["ignore"])
    kinds = "|".join(tool["fragment"])
    assert [name for name in names if not re.fullmatch(rf"\+[\w-]+\.({kinds})\.md", name)] == []
    assert "<!-- towncrier release notes start -->" in (REPOSITORY / tool["filename"]).read_text()
