"""Losses, gradients, one step and schedules of the authors' trainings, against their own code.

Most of the references are too large to be kept here: they are compared where their folder lies
beside the repository.
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
from shiftsim.planners.learned.features import agent_features  # noqa: E402
from shiftsim.sim.planner import History  # noqa: E402
from shiftsim.train import imitation, learning, samples  # noqa: E402
from shiftsim.world.state import Tracks, center_poses  # noqa: E402

SHARED = places.REPOSITORY.parent / "shared" / "reference" / "training"
KEPT = places.GOLDEN / "training"
pytestmark = [pytest.mark.golden, pytest.mark.learned, pytest.mark.slow]
LOSS, GRADIENT = 1e-6, 1e-4  # relative
NOISE = 1e-6  # of the norm of all gradients; what is smaller is rounding
WIDE = {"plantf": INPUTS, "pluto": PLUTO_INPUTS}
FUTURE = slice(-80, None)


def load(name: str) -> dict[str, Any]:
    path = SHARED / f"{name}.npz"
    path = path if path.exists() else KEPT / f"{name.replace('/', '_')}.npz"
    if not path.exists():
        pytest.skip(f"{name} is not kept in the repository")
    with np.load(path, allow_pickle=False) as file:
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


@pytest.mark.parametrize("name", ["nocil_official", "nocil_correctmask", "cil"])
def test_pluto_losses_and_gradients(name: str, dropped: Any) -> None:
    stored = load(f"pluto/train_{name}")
    dropped(stored["draw/state_dropout_u"])
    network = network_of("pluto", str(stored["meta/variant"]))
    network.planning_decoder.misordered_masks = name != "nocil_correctmask"
    given = below(stored if name == "cil" else load("pluto/train_nocil_official"), "in/")
    out = network(inputs_of("pluto", given))
    hidden = network.hidden_proj(out.ego)
    target = torch.cat(
        [
            imitation.motion(tensor(given["agent.target"])),
            tensor(given["agent.velocity"][:, :, FUTURE]),
        ],
        dim=-1,
    )
    contrast = (hidden, tensor(given["data_n_valid_mask"])) if name == "cil" else None
    losses = imitation.pluto_loss(
        out,
        target,
        tensor(given["agent.valid_mask"][..., FUTURE]),
        tensor(given["reference_line.future_projection"]),
        signed=tensor(given["cost_maps"][..., 0]),
        contrast=contrast,
    )
    known = below(stored, "f64/loss/")
    for term, value in losses.items():
        assert value.item() == pytest.approx(float(known[term].reshape(())), rel=LOSS), term
    losses["loss"].backward()
    compare_gradients(network, stored)


def test_pluto_lines_modes_and_contrast() -> None:
    stored = load("pluto/assignment_contrast")
    valid = torch.arange(80) < tensor(stored["n_valid"])[:, None]
    lines = tensor(stored["line_valid"])
    line, mode = imitation.pluto_assignment(tensor(stored["future_projection"]), lines, valid)
    assert line.tolist() == stored["r_star"].tolist()
    assert mode.tolist() == stored["m_star"].tolist()
    hidden = tensor(stored["contrast/hidden"]).requires_grad_()
    there = tensor(stored["contrast/valid"])
    loss = imitation.contrastive_loss(hidden, there)
    assert loss.item() == pytest.approx(float(stored["contrast/loss"]), rel=LOSS)
    loss.backward()
    np.testing.assert_allclose(hidden.grad, stored["contrast/grad_hidden"], atol=1e-6)
    assert imitation.contrastive_loss(hidden, ~there & there).item() == 0.0


@pytest.mark.parametrize("shape", ["square", "wide"])
def test_pluto_road_loss(shape: str) -> None:
    stored = below(load("pluto/esdf_loss"), f"{shape}/")
    trajectory = tensor(stored["trajectory"]).requires_grad_()
    loss = imitation.road_loss(trajectory, tensor(stored["sdf"]))
    assert loss.item() == pytest.approx(float(stored["loss"]), rel=LOSS)
    loss.backward()
    np.testing.assert_allclose(trajectory.grad, stored["grad_trajectory"], atol=1e-6)


def test_diffusion_loss() -> None:
    stored = load("diffusion_planner/train_aug")
    score = tensor(stored["mid/score"]).requires_grad_()
    there = ~tensor(stored["mask/neighbor_future_mask"])
    losses = imitation.diffusion_loss(score[:, :, 1:], tensor(stored["derived/x0"]), there)
    for name, value in below(stored, "loss/").items():
        assert losses[name].item() == pytest.approx(float(value), rel=LOSS), name
    losses["loss"].backward()
    np.testing.assert_allclose(score.grad, stored["grad_out/score"], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("planner", ["plantf", "pluto"])
def test_groups_and_rates(planner: str) -> None:
    stored, network = load(f"{planner}/optim"), network_module(planner).build_network()
    groups = imitation.parameter_groups(network)
    names = {id(value): name for name, value in network.named_parameters()}
    for group, known, decay in zip(
        groups, ("decay", "no_decay"), stored["weight_decay"], strict=True
    ):
        assert sorted(names[id(v)] for v in group["params"]) == sorted(stored[known].tolist())
        assert group["weight_decay"] == decay
    rates = [imitation.rate_of_epoch(epoch) for epoch in range(25)]
    np.testing.assert_allclose(rates, stored["lr_per_epoch"], rtol=1e-9)


def test_rates_of_diffusion_planner() -> None:
    rates = load("diffusion_planner/optim_ema")["lr_per_epoch"]
    ours = [imitation.diffusion_rate_of_epoch(epoch) for epoch in range(len(rates))]
    np.testing.assert_allclose(ours, rates, rtol=1e-9)


def test_a_step_of_the_optimiser(dropped: Any) -> None:
    stored = load("plantf/train_base_sde")
    dropped(stored["draw/state_dropout_u"])
    network, given = network_of("plantf", "base"), below(stored, "in/")
    out = network(inputs_of("plantf", given))
    valid = tensor(given["agent.valid_mask"][..., FUTURE])
    imitation.plantf_loss(out, tensor(given["agent.target"]), valid)["loss"].backward()
    norm = torch.nn.utils.clip_grad_norm_(network.parameters(), learning.CLIP)
    assert norm.item() == pytest.approx(float(stored["f64/step/grad_norm_before_clip"]), rel=1e-6)
    optimiser = torch.optim.AdamW(
        imitation.parameter_groups(network), lr=imitation.rate_of_epoch(0)
    )
    optimiser.step()
    own = dict(network.named_parameters())
    for name, after in below(stored, "step/after/").items():
        np.testing.assert_allclose(own[name].detach(), after, atol=2e-6, err_msg=name)


AUGMENTED = ["free", "not_drawn", "speed_clip", "collision", "collision_free_other_side"]
AUGMENTED += ["eleventh_row_ignored"]


def history_of(poses: Any, velocities: Any, sizes: Any, valid: Any, ego: Any) -> Any:
    """The past of rows of agents (A, 21, ...), of which the ego (21, 11) is not one."""
    count = len(poses)
    tracks = Tracks(
        valid=valid.T,
        poses=np.where(valid[..., None], poses, np.nan).swapaxes(0, 1),
        velocities=velocities.swapaxes(0, 1),
        sizes=sizes.swapaxes(0, 1),
        kinds=np.zeros(count, np.int64),
        tokens=tuple(map(str, range(count))),
    )
    return History(100_000 * np.arange(21), ego, tracks)


@pytest.mark.parametrize("case", AUGMENTED)
def test_plantf_augmentation(case: str) -> None:
    stored = below(load("plantf/augmentation"), f"{case}/")
    given, made = below(stored, "in/"), below(stored, "out/")
    state = samples.perturbed_state(given["current_state"], stored["noise"].astype(np.float64))
    poses = np.dstack([given["agent.position"], given["agent.heading"]])
    sizes = given["agent.shape"][..., ::-1]
    safe = samples.is_free(state[:3], poses[1:11, 20], sizes[1:11, 20])
    if stored["rand"] >= samples.PERTURBED:
        assert not stored["applied"]
        return
    np.testing.assert_allclose(state, stored["new_state"], atol=1e-9)
    assert safe == bool(stored["safe"]) == bool(stored["applied"])
    if not made:
        return
    if "current_state" in made:
        np.testing.assert_allclose(state[3:], made["current_state"][3:], atol=1e-9)
    ours = samples.targets(np.vstack([state[None, :3], poses[1:, 20]]), poses[:, 21:], state[:3])
    there = given["agent.valid_mask"][:, 21:]
    np.testing.assert_allclose(ours[there], made["agent.target"][there], atol=2e-6)
    valid, ego = given["agent.valid_mask"][:, :21], np.zeros((21, 11))
    ego[:, :3] = poses[0, :21]
    ego[-1, :3] = state[:3]
    velocities = given["agent.velocity"][1:, :21]
    past = history_of(poses[1:, :21], velocities, sizes[1:, :21], valid[1:], ego)
    read = agent_features(past, center_poses(poses[0, 20]), 64)
    order = [0, *(1 + read.tracks)]
    for name in ("position", "heading", "velocity"):
        theirs = made[f"agent.{name}"][order, :21]
        both = read.valid.copy()
        both[0] &= name != "velocity"  # of the ego; it is not read
        found = getattr(read, name)[both]
        np.testing.assert_allclose(found, theirs[both], atol=2e-6, err_msg=name)


@pytest.mark.parametrize("case", ["free_costmap", "collision_half", "collision_all_five"])
def test_pluto_augmentation(case: str) -> None:
    stored = below(load("pluto/positive"), f"{case}/")
    given, made = below(stored, "in/"), below(stored, "out/")
    poses = np.dstack([given["agent.position"], given["agent.heading"]])
    boxes = poses[1:11, 20], given["agent.shape"][1:11, 20, ::-1]
    noise, tries = stored["noise"].astype(np.float64), samples.KINDS["pluto"].tries
    free = lambda pose: samples.is_free(pose, *boxes)  # noqa: E731
    state = samples.free_state(given["current_state"], noise, free, tries)
    assert state is not None
    np.testing.assert_allclose(state, given["current_state"] + stored["scale"] * noise, atol=1e-9)
    np.testing.assert_allclose(state[3:], made["current_state"][3:], atol=1e-9)
    present = np.vstack([state[None, :3], poses[1:, 20]])
    velocities = given["agent.velocity"][:, 21:]
    ours = samples.motion_targets(present, poses[:, 21:], velocities, state[:3])
    target = tensor(made["agent.target"])
    theirs = np.dstack([imitation.motion(target), made["agent.velocity"][:, 21:]])
    there = given["agent.valid_mask"][:, 21:]
    np.testing.assert_allclose(ours[there], theirs[there], atol=2e-6)


def test_boxes_of_the_augmentation() -> None:
    stored = below(load("plantf/augmentation"), "boxes/")
    for ego, position, heading, shape, safe in zip(
        *(stored[name] for name in ("ego_pose", "position", "heading", "shape_wl", "safe")),
        strict=True,
    ):
        box = np.array([[*position, heading]])
        assert samples.is_free(ego, box, shape[None, ::-1].astype(np.float64)) == safe
