"""The rules of nuPlan and the page on architecture name what exists, and comments name rules."""

import ast
import re

import pytest
from places import REPOSITORY

SOURCES = [
    path
    for folder in ("shiftsim", "planners", "metrics", "data", "benchmarks", "tests/parity")
    for path in sorted((REPOSITORY / folder).rglob("*.py"))
]
RULES = (REPOSITORY / "docs" / "nuplan_rules.md").read_text("utf-8")
ARCHITECTURE = (REPOSITORY / "docs" / "architecture.md").read_text("utf-8")
CONTRIBUTING = (REPOSITORY / "CONTRIBUTING.md").read_text("utf-8")
PLACES = re.findall(
    r"`((?:[\w-]+/)+[\w.-]*)`((?:(?:,| and)? `[\w.]+`)*)", RULES + ARCHITECTURE + CONTRIBUTING
)
_CITED = re.compile(r"nuPlan rules? (\d+(?:(?:,| and|, and)\s+(?:#\s+)?\d+)*)")


def rule_numbers():
    return [int(number) for number in re.findall(r"^### (\d+)\. ", RULES, re.MULTILINE)]


def cited_numbers(text):
    return {int(n) for found in _CITED.findall(text) for n in re.findall(r"\d+", found)}


def test_rules_are_numbered_upwards():
    numbers = rule_numbers()
    assert len(numbers) > 50
    assert numbers == sorted(set(numbers))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_what_is_cited_exists(path):
    text = path.read_text("utf-8")
    assert cited_numbers(text) <= set(rule_numbers())
    pages = {page.name for page in (*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/*.md"))}
    of_references = {"README.md", "RESULTS.md"}
    assert set(re.findall(r"\b([\w-]+\.md)\b", text)) <= pages | of_references


def test_every_rule_is_cited():
    cited = set().union(*(cited_numbers(path.read_text("utf-8")) for path in SOURCES))
    assert set(rule_numbers()) - cited == set()


@pytest.mark.parametrize(("place", "names"), sorted(set(PLACES)))
def test_every_place_that_is_named_exists(place, names):
    path = REPOSITORY / place
    assert path.exists()
    if path.suffix == ".py":
        assert set(re.findall(r"\w+", names)) - {"and"} <= names_in(path.read_text("utf-8"))


def names_in(source):
    """Everything that a module defines, at whatever depth."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
    return found
