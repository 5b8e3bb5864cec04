"""Result folders that nuPlan's own simulation wrote; what users compare with `verify --experiment`.

That a changed number is noticed is tested in tests/verify.
"""

from pathlib import Path

import pytest
from parity_cases import Cases, Scenes

from shiftsim.verify.experiment import verify_experiment

pytestmark = [pytest.mark.golden, pytest.mark.slow, pytest.mark.reference("nuplan_experiment")]


def test_results(folder: Path, scenes: Scenes, cases: Cases) -> None:
    found = verify_experiment(folder, scenes.by_token, cases.mode)
    cases.quantities, cases.mismatches = found.quantities, found.mismatches
    cases.not_covered, cases.informative = found.not_covered, found.informative
