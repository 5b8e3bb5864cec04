"""Mutants are made as intended, and the tests notice all of a sample but those that are equal."""

import ast
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from mutants import equal_mutants
from mutated import GROUPS, all_mutants, modules, shared_sample
from mutations import mutants_of, sample

SCRIPT = Path(__file__).with_name("mutants.py")
RATE = 92.0  # per cent that must be noticed
SOURCE = '''
"""A module."""
LIMIT = 2.0


def clipped(values: list[float], count: int = 3) -> tuple[int, float]:
    """Some text."""
    best = abs(values[count])
    if best <= LIMIT and not count:
        raise ValueError(f"{count + 1} is too many", 1 + 1)
    best += min(best, 0.0)
    return count, best
'''
CHANGES = {
    "LIMIT: `2.0` -> `3.0`",
    "LIMIT: `2.0` -> `0.0`",
    "clipped: `3` -> `4`",
    "clipped: `3` -> `2`",
    "clipped: `best = abs(values[count])` -> `best = values[count]`",
    "clipped: `best = abs(values[count])` -> `best = abs(values[count - 1])`",
    "clipped: `best <= LIMIT and (not count)` -> `best <= LIMIT or not count`",
    "clipped: `best <= LIMIT and (not count)` -> `not (best <= LIMIT and (not count))`",
    "clipped: `best <= LIMIT and (not count)` -> `best < LIMIT and (not count)`",
    "clipped: `best <= LIMIT and (not count)` -> `best > LIMIT and (not count)`",
    "clipped: `best <= LIMIT and (not count)` -> `best <= LIMIT and count`",
    "clipped: `raise ValueError(f'{count + 1} is too many', 1 + 1)` -> `pass`",
    "clipped: `best += min(best, 0.0)` -> `pass`",
    "clipped: `best += min(best, 0.0)` -> `best += max(best, 0.0)`",
    "clipped: `best += min(best, 0.0)` -> `best += min(best, 1.0)`",
    "clipped: `return (count, best)` -> `return (best, count)`",
}


def test_every_kind_of_change_is_made_and_texts_are_left_alone() -> None:
    mutants = mutants_of("toy", SOURCE)
    assert {mutant.name for mutant in mutants} == {f"toy {change}" for change in CHANGES}
    for mutant in mutants:
        assert ast.unparse(mutant.statement) not in map(ast.unparse, ast.parse(SOURCE).body)


def test_a_sample_hardly_changes_with_the_source() -> None:
    before = mutants_of("toy", SOURCE)
    after = mutants_of("toy", SOURCE.replace("LIMIT = 2.0", "\n\nBOUND = 1\nLIMIT = 2.0"))
    chosen = sample(before, 8, 1)
    assert chosen == sample(before[::-1], 8, 1) != sample(before, 8, 2)
    assert len(set(chosen) & set(sample(after, 8, 1))) >= 6


@pytest.mark.thorough
def test_every_group_has_the_same_share_of_a_sample() -> None:
    group_of, chosen = modules(), shared_sample(40, 1)
    assert Counter(group_of[mutant.module] for mutant in chosen) == dict.fromkeys(GROUPS, 8)
    assert set(chosen) < set(shared_sample(80, 1))


def run(*options: str) -> float:
    """Run the script, which must find no survivor that is not listed; per cent that are noticed."""
    command = [sys.executable, str(SCRIPT), "--workers", "1", *options]
    done = subprocess.run(command, capture_output=True, text=True, cwd=SCRIPT.parent.parent)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    rate = re.search(r"all: .* killed \((.*)%\)", done.stdout)
    assert rate is not None
    return float(rate[1])


@pytest.mark.thorough
def test_a_few_mutants_are_noticed_or_listed_as_equal() -> None:
    run("--count", "25")


@pytest.mark.thorough
def test_the_list_of_equal_mutants_names_no_others() -> None:
    assert equal_mutants() <= {mutant.name for mutant in all_mutants()}


@pytest.mark.long
def test_four_hundred_mutants_are_noticed() -> None:
    assert run("--count", "400", "--check") >= RATE
