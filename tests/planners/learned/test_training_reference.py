"""In training the networks give the outputs and gradients of the official code."""

import zlib

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from shiftsim.planners.learned.checkpoint import load_network  # noqa: E402
from shiftsim.planners.learned.plantf import network as plantf  # noqa: E402
from shiftsim.planners.learned.pluto import network as pluto  # noqa: E402

pytestmark = [pytest.mark.learned, pytest.mark.golden]

OUTPUT = 2e-5  # the tolerances that the reference advises
NORM, DIRECTION = 1e-3, 2e-3  # errors of a gradient over its norm: of that, along a probe
SMALL = 1e-6  # gradients below this share of all hold rounding noise only


@pytest.fixture
def reference(shared):
    def read(name):
        path = shared / "reference" / "training" / name
        if not path.is_file():
            pytest.skip(f"needs {path}")
        return np.load(path)

    return read


def inputs_of(file, *, sides):
    """What `SceneTensors` and PLUTO's further inputs have, from a collated batch."""
    now = 21  # samples up to the present

    def read(name):
        return torch.from_numpy(file[f"in/{name}"])

    moving = ("position", "heading", "velocity")
    agent = {name: read(f"agent.{name}")[:, :, :now] for name in moving}
    points = [read(f"map.point_{name}") for name in ("position", "vector", "orientation")]
    return {
        **agent,
        "shape": read("agent.shape")[:, :, :now],
        "valid": read("agent.valid_mask")[:, :, :now],
        "category": read("agent.category").long(),
        "current_state": read("current_state"),
        "points": points[0] if sides else points[0][:, :, 0],
        "vectors": points[1][:, :, 0],
        "orientations": points[2][:, :, 0],
        "centers": read("map.polygon_center"),
        "kind": read("map.polygon_type").long(),
        "on_route": read("map.polygon_on_route").long(),
        "light": read("map.polygon_tl_status").long(),
        "has_limit": read("map.polygon_has_speed_limit"),
        "limit": read("map.polygon_speed_limit"),
        "point_valid": read("map.valid_mask"),
    }


def compare_gradients(network, file):
    """Norms of all gradients, and their parts along the probes of the reference."""
    parameters, total = dict(network.named_parameters()), float(file["grad/total_norm"])
    compared = 0
    for name, norm, along in zip(
        *(file[f"grad/{part}"] for part in ("names", "norm", "dot_probe")), strict=True
    ):
        gradient = parameters[name].grad
        if np.isnan(norm):
            assert gradient is None or not gradient.any(), name
            continue
        found = gradient.double().numpy()
        if norm <= SMALL * total:
            assert np.linalg.norm(found) < 10 * SMALL * total, name
            continue
        probe = np.random.Generator(np.random.PCG64(zlib.crc32(f"probe:{name}".encode())))
        direction = probe.standard_normal(found.shape)
        if found.ndim >= 2:
            direction /= np.sqrt(np.prod(found.shape[1:]))
        assert np.linalg.norm(found) == pytest.approx(norm, rel=NORM), name
        assert (found * direction).sum() == pytest.approx(along, abs=DIRECTION * norm), name
        compared += 1
    assert compared > 0.8 * len(parameters)


def compare_statistics(network, file):
    """Running means and variances after the step."""
    layers = {key.split("/")[1] for key in file.files if key.startswith("bn/")}
    assert len(layers) >= 2
    for layer in layers:
        norm = network.get_submodule(layer)
        np.testing.assert_allclose(norm.running_mean, file[f"bn/{layer}/after_mean"], atol=2e-5)
        np.testing.assert_allclose(norm.running_var, file[f"bn/{layer}/after_var"], rtol=1e-5)


def prepared(planner, file, monkeypatch):
    """The network in training; the official draw decides which states it is shown."""
    network = load_network("deterministic:base", planner).train()
    drawn = torch.from_numpy(file["draw/state_dropout_u"])
    monkeypatch.setattr(torch, "rand", lambda shape, **options: drawn)
    return network


def test_plantf(reference, monkeypatch):
    file = reference("plantf/train_base_sde.npz")
    network = prepared("plantf", file, monkeypatch)
    out = network(plantf.Inputs(**inputs_of(file, sides=False)))._asdict()
    for name, value in out.items():
        np.testing.assert_allclose(value.detach(), file[f"out/{name}"], rtol=0.0, atol=OUTPUT)
    torch.autograd.backward(
        list(out.values()), [torch.from_numpy(file[f"grad_out/{name}"]) for name in out]
    )
    compare_gradients(network, file)
    compare_statistics(network, file)


@pytest.mark.parametrize("masks", ["correctmask", "official"])
def test_pluto(reference, monkeypatch, masks):
    file = reference(f"pluto/train_nocil_{masks}.npz")
    inputs = reference("pluto/train_nocil_official.npz")
    network = prepared("pluto", file, monkeypatch)
    network.planning_decoder.misordered_masks = masks == "official"

    def read(name):
        return torch.from_numpy(inputs[f"in/{name}"])

    objects = [read(f"static_objects.{name}") for name in ("position", "heading")]
    lines = {name: read(f"reference_line.{name}") for name in ("position", "vector", "orientation")}
    out = network(
        pluto.Inputs(
            **inputs_of(inputs, sides=True),
            object_pose=torch.cat([objects[0], objects[1][..., None]], dim=-1),
            object_shape=read("static_objects.shape"),
            object_category=read("static_objects.category").long(),
            object_valid=read("static_objects.valid_mask"),
            line_points=lines["position"],
            line_vectors=lines["vector"],
            line_orientations=lines["orientation"],
            line_valid=read("reference_line.valid_mask"),
        )
    )
    known = [name for name in out._fields if f"grad_out/{name}" in file.files]
    for name in known:
        found = getattr(out, name).detach()
        np.testing.assert_allclose(found, file[f"out/{name}"], rtol=0.0, atol=OUTPUT)
    # the official loss writes into the logits, whose gradients are not stored
    best = torch.from_numpy(file["derived/r_star"] * 12 + file["derived/m_star"])
    loss = torch.nn.functional.cross_entropy(out.probability.flatten(1), best)
    assert float(loss.detach()) == pytest.approx(float(file["loss/cls_loss"]), rel=1e-4)
    loss.backward(retain_graph=True)
    moved = [name for name in known if name != "probability"]
    torch.autograd.backward(
        [getattr(out, name) for name in moved],
        [torch.from_numpy(file[f"grad_out/{name}"]) for name in moved],
    )
    compare_gradients(network, file)
    compare_statistics(network, file)


@pytest.mark.parametrize("planner", ["carl", "diffusion-planner", "plantf", "pluto"])
def test_no_function_stands_in_the_way_of_a_gradient(planner):
    """Modules are torch's own in training mode: parameters want gradients, buffers are theirs."""
    network = load_network("deterministic:base", planner).train()
    assert all(parameter.requires_grad for parameter in network.parameters())
    assert all(parameter.is_leaf for parameter in network.parameters())
