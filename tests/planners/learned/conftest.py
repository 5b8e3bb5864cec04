"""What tests of planners share."""

import pytest


@pytest.fixture
def checkpoints(tmp_path, monkeypatch):
    """The folder of checkpoints, at first empty."""
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    monkeypatch.setenv("SHIFTSIM_CHECKPOINTS", str(folder))
    return folder


@pytest.fixture
def no_weights_of_our_own(monkeypatch):
    """As in a checkout without them."""
    monkeypatch.setattr("shiftsim.planners.table.shipped_file", lambda planner: None)


@pytest.fixture
def own_weights(tmp_path, monkeypatch):
    """A file that stands for our own weights of CaRL, in this process."""
    from checkpoint_files import state_of
    from safetensors.torch import save_file

    path = tmp_path / "shiftsim.safetensors"
    save_file({name: value.contiguous() for name, value in state_of("carl").items()}, path)
    monkeypatch.setattr(
        "shiftsim.planners.table.shipped_file",
        lambda planner: path if planner == "carl" else None,
    )
    return path
