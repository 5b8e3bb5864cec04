"""What tests of planners share."""

import pytest


@pytest.fixture
def checkpoints(tmp_path, monkeypatch):
    """The folder of checkpoints, at first empty."""
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    monkeypatch.setenv("SHIFTSIM_CHECKPOINTS", str(folder))
    return folder
