"""Losses, gradients, one step and schedules of the authors' trainings, against their own code.

What the folder of references has is compared where it lies beside the repository. It is too large
to be kept here; `tests/train/test_imitation_losses.py` has small cases.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import places
import pytest
from parity_nets import CODES, INPUTS, PLUTO_INPUTS

torch = pytest.importorskip("torch")

from shiftsim.planners.learned.checkpoint import network_module  # noqa: E402
from shiftsim.planners.learned.deterministic import keyed_normals, network_weights  # noqa: E402
from shiftsim.train import imitation  # noqa: E402

FOLDER = places.REPOSITORY.parent / "shared" / "reference" / "training"
pytestmark = [
    pytest.mark.golden,
    pytest.mark.learned,
    pytest.mark.slow,
    pytest.mark.skipif(not FOLDER.is_dir(), reason="the references are not beside the repository"),
]
LOSS, GRADIENT = 1e-6, 1e-4  # relative
NOISE = 1e-6  # of the norm of all gradients; what is smaller is rounding
WIDE = {"plantf": INPUTS, "pluto": PLUTO_INPUTS}
FUTURE = slice(-80, None)


def load(name: str) -> dict[str, Any]:
    with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as file:
        return dict(file)


def tensor(array: Any) -> Any:
    given = torch.from_numpy(np.ascontiguousarray(array))
    return given.double() if given.is_floating_point() else given


def below(stored: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    return {n.removeprefix(prefix): v for n, v in stored.items() if n.startswith(prefix)}


def read(stored: Mapping[str, Any], where: str) -> Any:
    """An array by a name with an index behind it; agents without their future."""
    name, _, index = where.partition("[")
    array = eval(f"array[{index}", {"array": stored[name]}) if index else stored[name]
    is_history = name.startswith("agent.") and array.ndim > 2
    return array[:, :, :21] if is_history else array


def inputs_of(planner: str, stored: Mapping[str, Any]) -> Any:
    fields = {}
    for field, where in WIDE[planner].items():
        if isinstance(where, list):
            array = np.dstack([read(stored, name) for name in where])
        else:
            array = read(stored, where)
        fields[field] = tensor(array).long() if field in CODES else tensor(array)
    return network_module(planner).Inputs(**fields)


def network_of(planner: str, variant: str) -> Any:
    module = network_module(planner)
    network = module.build_network()
    state = network_weights(module, variant)
    network.load_state_dict({name: torch.from_numpy(value) for name, value in state.items()})
    return network.double().train()


def compare_gradients(network: Any, stored: Mapping[str, Any]) -> None:
    """Norm and product with a probe of every gradient, which the authors' code has as doubles."""
    names = stored["grad/names"].tolist()
    own = dict(network.named_parameters())
    assert sorted(names) == sorted(own)
    total = float(stored["f64/grad/total_norm"])
    for name, norm, dot in zip(
        names, stored["f64/grad/norm"], stored["f64/grad/dot_probe"], strict=True
    ):
        gradient = own[name].grad
        if name in stored["grad/none"]:
            assert gradient is None
            continue
        shape = tuple(gradient.shape)
        probe = keyed_normals(f"probe:{name}", shape)
        probe = probe / np.sqrt(np.prod(shape[1:])) if len(shape) > 1 else probe
        if norm > NOISE * total:
            assert float(gradient.norm()) == pytest.approx(norm, rel=GRADIENT), name
            found = float((gradient.numpy() * probe).sum())
            assert found == pytest.approx(dot, abs=GRADIENT * norm), name
        else:
            assert float(gradient.norm()) < 10.0 * NOISE * total, name


@pytest.fixture
def dropped(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Gives the state dropout its numbers."""

    def give(numbers: Any) -> None:
        monkeypatch.setattr(torch, "rand", lambda *shape, **options: tensor(numbers))

    return give


def test_plantf_losses_and_gradients(dropped: Any) -> None:
    stored = load("plantf/train_base_sde")
    dropped(stored["draw/state_dropout_u"])
    network = network_of("plantf", "base")
    given = below(stored, "in/")
    out = network(inputs_of("plantf", given))
    for name, value in below(stored, "out/").items():
        np.testing.assert_allclose(getattr(out, name).detach(), value, atol=2e-5)
    valid = tensor(given["agent.valid_mask"][..., FUTURE])
    losses = imitation.plantf_loss(out, tensor(given["agent.target"]), valid)
    for name, value in below(stored, "f64/loss/").items():
        assert losses[name].item() == pytest.approx(float(value), rel=LOSS), name
    losses["loss"].backward()
    compare_gradients(network, stored)
    for layer in ("first_mlp.1", "second_mlp.1"):
        norm = network.get_submodule(f"map_encoder.polygon_encoder.{layer}")
        after = below(stored, f"bn/map_encoder.polygon_encoder.{layer}/")
        np.testing.assert_allclose(norm.running_mean, after["after_mean"], atol=2e-5)
        np.testing.assert_allclose(norm.running_var, after["after_var"], rtol=1e-5)
