"""The tally of a verification: what counts as equal, and what the exit code says."""

import numpy as np
import pytest

from shiftsim.verify.report import Report


@pytest.mark.parametrize(
    ("actual", "expected", "atol", "equal"),
    [
        (1.0, 1.0 + 1e-10, 1e-9, True),
        (1.0, 1.0 + 1e-8, 1e-9, False),
        ([np.nan, np.inf], [np.nan, np.inf], 0.0, True),
        ([np.nan, 1.0], [1.0, 1.0], 1.0, False),
        ([np.inf], [-np.inf], 1.0, False),
        ([1.0, 2.0], [1.0], 1.0, False),
        (["a", "b"], ["a", "c"], 1.0, False),
        ([True, False], [True, True], 1.0, False),
        ([3], [4], 5.0, False),
        ([None], [None], 0.0, True),
        ([], [], 0.0, True),
    ],
)
def test_values_are_equal_only_within_the_tolerance(actual, expected, atol, equal):
    report = Report()
    assert report.compare("q", "w", actual, expected, atol=atol) is equal
    assert report.exit_code() == (0 if equal else 1)


def test_a_mismatch_names_quantity_case_and_place():
    report = Report()
    report.compare("speed", "scene s01", [1.0, 2.0, 9.0], [1.0, 2.0, 3.0], atol=1e-9)
    assert report.mismatches == ["speed: scene s01: 9.0, not 3.0 at 2 (1 of 3 values)"]


def test_nothing_compared_is_not_success():
    assert Report().exit_code() == 2


def test_uncovered_cases_fail_only_when_all_are_required():
    report = Report()
    report.compare("q", "w", 1, 1)
    report.skip("other", 3)
    assert report.exit_code() == 0
    assert report.exit_code(require_all=True) == 3
    assert report.lines()[-1] == "1 cases covered, 0 mismatches, 3 not covered"


def test_a_mismatch_goes_before_what_is_not_covered():
    report = Report()
    report.fail("q", "w", "could not be computed")
    report.skip("other")
    assert report.exit_code(require_all=True) == 1
