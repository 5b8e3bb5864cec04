"""Checkpoints: found by path or name, opened without running them, loaded strictly.

The authors' own files are read as published: PyTorch-Lightning files (`state_dict`, names with
`model.`), Diffusion Planner's `model.pth` (`ema_state_dict`, names with `module.`, `args.json`
beside it), CaRL's bare state, and safetensors files made of those by `shiftsim checkpoint convert`.
The words `deterministic:base` and `deterministic:drive` stand for weights made from the names of
the tensors: good for trying that everything runs; their scores mean nothing. `official` is the
published file in the folder of checkpoints, `shiftsim` our own weights; without any word it is the
first of the two that is there. At the end: where a network runs, and that it computes the same each
time.
"""

import hashlib
import importlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from shiftsim.errors import CheckpointError, ConfigError, MissingExtraError, nearest
from shiftsim.files import checkpoint_folder, expand
from shiftsim.planners import table
from shiftsim.planners.learned import reader
from shiftsim.planners.learned.deterministic import network_weights
from shiftsim.planners.table import OFFICIAL, PUBLISHED, SHIPPED, SHIPPED_NOTE
from shiftsim.world.ranges import CHECKPOINT

DETERMINISTIC = ("deterministic:base", "deterministic:drive")
SUFFIXES = (".ckpt", ".pth", ".safetensors")
_MEMBER = "model_best.pth"  # of CaRL: one folder for each policy
_FILES = ("model.pth", _MEMBER)  # what is meant by a folder
_ENTRIES = ("ema_state_dict", "state_dict", "model")  # where weights are, the first that is there
_PREFIXES = ("model.", "module.", "_orig_mod.")
_WITH_ARGS = ("diffusion-planner",)  # planners whose weights mean nothing without their args
LIKENESS = 0.5  # share of equal names and shapes from which on a file is said to be of a planner
_NAMED = 3  # tensors named in a message

Shapes: TypeAlias = Mapping[str, tuple[int, ...]]


class Weights(NamedTuple):
    """What is loaded into a network."""

    state: dict[str, Any]  # tensors by official name, complete, of the network's own types
    args: dict[str, Any] | None  # settings of the network that came with them, or None


class Checkpoint(NamedTuple):
    """A checkpoint file as read, for whatever planner it is."""

    path: Path  # the file
    container: str  # what kind of file it is, and where in it the weights are
    state: dict[str, Any]  # tensors by name without prefixes
    args: dict[str, Any] | None  # settings of the network beside them, or None
    skipped: tuple[str, ...]  # what was left out: other entries, and objects of foreign classes
    made_from: str = ""  # SHA-256 of the file that this one was converted from, or empty


def load_network(spec: str, planner: str, *, device: str = "cpu") -> Any:
    """A planner's network with its weights, on its device, by arguments of `load_weights`."""
    weights = load_weights(spec, planner, device=device)
    network = network_module(planner).build_network(weights.args)
    network.load_state_dict(weights.state)
    return network.to(resolve_device(device)).eval()


def load_weights(spec: str, planner: str, *, device: str = "cpu") -> Weights:
    """Weights of a planner's network, strictly all and nothing else.

    `spec` is a file, a folder that holds one, a name in the folder of checkpoints, or one of
    `DETERMINISTIC`; `official`, `shiftsim`, or empty for the first of these two. The tensors go to
    the `device`, as in `resolve_device`, where torch is set up for inference.

    Raises CheckpointError: there is no such file, it is damaged, or it is of another network.
    ConfigError: there is no such device. MissingExtraError: PyTorch is not installed.
    """
    require_torch(f"planner {planner!r}")
    import torch

    place = resolve_device(device)
    prepare_inference(place)
    if spec.startswith("deterministic:"):
        variant = _known_deterministic(spec).removeprefix("deterministic:")
        weights = network_weights(network_module(planner), variant)
        state, args = {name: torch.from_numpy(value) for name, value in weights.items()}, None
    else:
        found = open_checkpoint(find_checkpoint(spec, planner))
        args = needed_args(found, planner)
        state = checked_state(found, planner, args)
    return Weights({name: value.to(place) for name, value in state.items()}, args)


def checkpoint_fingerprint(spec: str, planner: str) -> str:
    """What tells these weights from others: hashes of the files with commas, or words as given."""
    return ",".join(_fingerprint(part, planner) for part in split_ensemble(spec, planner))


def weights_note(fingerprint: str, planner: str) -> str:
    """What has to be said of weights wherever their scores are; empty for those of others."""
    shipped = table.shipped_file(planner)
    own = shipped is not None and file_hash(shipped) in fingerprint.split(",")
    return SHIPPED_NOTE if own else ""


def split_ensemble(spec: str, planner: str = "") -> tuple[str, ...]:
    """The checkpoints of `A,B,C`, or of a folder with one folder for each; else the one given."""
    path = _meant_by(spec, planner) or expand(spec)
    members = [] if (path / _MEMBER).exists() else sorted(path.glob(f"*/{_MEMBER}"))
    if members:
        return tuple(str(member) for member in members)
    return (spec,) if path.exists() else tuple(part.strip() for part in spec.split(","))


def find_checkpoint(spec: str, planner: str = "") -> Path:
    """The file that is meant; else a CheckpointError."""
    meant = _meant_by(spec, planner)
    given, named = meant or expand(spec), meant or checkpoint_folder() / spec
    for path in (given, named, *(named.with_name(named.name + suffix) for suffix in SUFFIXES)):
        if path.is_file():
            return path
        if path.is_dir():
            return _inside(path)
    near = nearest(Path(spec).name, sorted(path.name for path in checkpoint_folder().glob("*")))
    whose = f" of planner {planner!r}" if planner else ""
    what = f"checkpoint {spec!r}{whose} does not exist, nor in {str(checkpoint_folder())!r}"
    raise CheckpointError(what, f"did you mean {near!r}?" if near else how_to_get(planner))


def _meant_by(spec: str, planner: str) -> Path | None:
    """What a word stands for; None where it is none, but the name of a file."""
    if not planner or spec not in ("", OFFICIAL, SHIPPED):
        return None
    official, shipped = PUBLISHED[planner].place, table.shipped_file(planner)
    if spec != SHIPPED and official.exists():
        return official
    if spec != OFFICIAL and shipped is not None:
        return shipped
    problem = {
        "": f"planner {planner!r} needs a checkpoint",
        OFFICIAL: f"the official checkpoint of planner {planner!r} is not at {str(official)!r}",
        SHIPPED: f"no weights of shiftsim's own for planner {planner!r} are installed",
    }[spec]
    raise CheckpointError(problem, hint=how_to_get(planner))


def how_to_get(planner: str) -> str:
    """What to do where a planner has no checkpoint, in one line."""
    if planner not in PUBLISHED:
        return "check the path"
    published = PUBLISHED[planner]
    own = f"--checkpoint {planner}={SHIPPED} for {SHIPPED_NOTE}"
    trial = "to try without: --checkpoint deterministic:drive (scores mean nothing)"
    return (
        f"get {published.describe()}, and put it at {published.place}, or --checkpoint PATH; "
        f"{trial if table.shipped_file(planner) is None else own}"
    )


def open_checkpoint(path: Path) -> Checkpoint:
    """The weights in a file, whatever planner they are of; else a CheckpointError."""
    contents = reader.read_contents(path)
    entry = next((e for e in _ENTRIES if isinstance(contents.entries.get(e), dict)), "")
    holder = contents.entries[entry] if entry else contents.entries
    tensors = {str(name): value for name, value in holder.items() if hasattr(value, "as_strided")}
    if not tensors:
        entries = ", ".join([*contents.entries][:8]) or "none"
        what, hint = "holds no tensors", reader.WRITTEN_HINT
        for name, value in contents.entries.items():
            if isinstance(value, dict) and any(
                hasattr(one, "as_strided") for one in value.values()
            ):
                what = f"holds its tensors in the entry {name!r}, not in one of {_ENTRIES}"
                hint = f"save that alone: torch.save(torch.load(FILE)[{name!r}], NEW)"
        what = f"checkpoint {str(path)!r} {what} (entries: {entries})"
        raise CheckpointError(what, hint)
    state = _without_prefixes(tensors)
    others = [name for name in contents.entries if name != entry] if entry else []
    others += [name for name in holder if name not in tensors]
    dropped = len(tensors) - len(state)
    if dropped:
        others.append(f"{dropped} tensors without the prefix of the others")
    return Checkpoint(
        path,
        f"{contents.container}, {entry}" if entry else contents.container,
        state,
        _args_of(path, contents),
        (*others, *contents.skipped),
        contents.metadata.get("source_sha256", ""),
    )


def _without_prefixes(tensors: dict[str, Any]) -> dict[str, Any]:
    """Names as the network has them; no network's own names begin with such a prefix."""
    state = tensors
    while prefix := next((p for p in _PREFIXES if any(n.startswith(p) for n in state)), ""):
        # nuPlan rule 330: the loader of Diffusion Planner drops what has no prefix; those of PlanTF
        # and PLUTO keep it, and fail
        state = {
            name.removeprefix(prefix): value
            for name, value in state.items()
            if prefix != "module." or name.startswith(prefix)
        }
    return state


def _args_of(path: Path, contents: reader.Contents) -> dict[str, Any] | None:
    """Settings in the file's own metadata, or in `args.json` beside it."""
    if "args" in contents.metadata:
        try:
            value = json.loads(contents.metadata["args"])
        except (ValueError, RecursionError) as error:
            what = f"checkpoint {str(path)!r}: args in it are not JSON"
            raise CheckpointError(what, reader.ARGS_HINT) from error
        return value if isinstance(value, dict) else None
    beside = path.parent / "args.json"
    return reader.read_json_object(beside) if beside.is_file() else None


def needed_args(found: Checkpoint, planner: str) -> dict[str, Any] | None:
    """Settings that a planner's network needs beside the weights; None for those without."""
    if planner not in _WITH_ARGS:
        return None
    if found.args is None:
        _require_likeness(found, planner)
        raise CheckpointError(
            f"checkpoint {str(found.path)!r} of planner {planner!r} has no args.json beside it",
            hint=f"get it where the checkpoint is from, project {PUBLISHED[planner].project}",
        )
    return found.args


def checked_state(
    found: Checkpoint, planner: str, args: Mapping[str, Any] | None
) -> dict[str, Any]:
    """All tensors of a network, and no other, of its types and shapes; or a CheckpointError."""
    try:
        wanted = empty_state(planner, args)
    except CheckpointError as error:
        what = f"checkpoint {str(found.path)!r}: {error.message}"
        raise CheckpointError(what, error.hint) from error
    problems = _differences(shapes_of(found.state), shapes_of(wanted))
    if problems:
        _require_likeness(found, planner)
        raise CheckpointError(
            f"checkpoint {str(found.path)!r} does not fit planner {planner!r}: tensors {problems}",
            hint=f"it must be of the published network, project {PUBLISHED[planner].project}",
        )
    state = {name: found.state[name].detach().to(wanted[name].dtype) for name in wanted}
    allowed = CHECKPOINT["weight"]
    for name, value in state.items():
        if not bool((value.double().abs() <= allowed.high).all()):
            what = f"{name} has values that are not finite or beyond {allowed}"
            hint = "the training has diverged, or the file is damaged"
            raise CheckpointError(f"checkpoint {str(found.path)!r}: {what}", hint)
    return state


def _require_likeness(found: Checkpoint, planner: str) -> None:
    """Raise where a checkpoint is not of the planner's network, but perhaps of another's."""
    other = most_like(shapes_of(found.state))
    if other == planner:
        return
    name = f"checkpoint {str(found.path)!r} is not for planner {planner!r}"
    if other:
        hint = f"--planner {other}, or {how_to_get(planner)}"
        raise CheckpointError(f"{name}: it looks like {other!r}", hint)
    raise CheckpointError(f"{name}, nor for any other known here", how_to_get(planner))


def network_module(planner: str) -> Any:
    """The module with a planner's network; it needs torch."""
    folder = planner.removesuffix("-planner")
    return importlib.import_module(f"shiftsim.planners.learned.{folder}.network")


def empty_state(planner: str, args: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The network's state with names, shapes and types, but without values."""
    import torch

    module = network_module(planner)
    try:
        with torch.device("meta"):
            return module.build_network(args).state_dict()
    except Exception as error:  # args of any content make code raise that takes them for granted
        raise CheckpointError(
            f"no network of {planner} can be built from its args ({type(error).__name__}: {error})",
            hint="use the args.json that was published with the checkpoint",
        ) from error


def shapes_of(state: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Shapes by name."""
    return {name: tuple(tensor.shape) for name, tensor in state.items()}


def most_like(shapes: Shapes) -> str:
    """The planner whose network has most of these names and shapes; empty where none has half."""
    likeness = {}
    for planner in PUBLISHED:
        wanted = shapes_of(empty_state(planner))
        equal = len(shapes.items() & wanted.items())
        likeness[planner] = equal / max(len(shapes), len(wanted))
    name = max(likeness, key=likeness.__getitem__)
    return name if likeness[name] >= LIKENESS else ""


def _differences(shapes: Shapes, wanted: Shapes) -> str:
    """What keeps these tensors from being loaded into a network, in words; empty where nothing."""
    dims = {name: "x".join(map(str, shape)) or "a scalar" for name, shape in shapes.items()}
    kinds = {
        "missing": [name for name in wanted if name not in shapes],
        "unexpected": [name for name in shapes if name not in wanted],
        "of another shape": [
            f"{name} is {dims[name]}, not {'x'.join(map(str, shape)) or 'a scalar'}"
            for name, shape in wanted.items()
            if shapes.get(name, shape) != shape
        ],
    }
    return "; ".join(
        f"{len(names)} {what}: {', '.join(names[:_NAMED])}"
        + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
        for what, names in kinds.items()
        if names
    )


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise reader.unreadable(path, error) from error


def _fingerprint(spec: str, planner: str) -> str:
    if spec.startswith("deterministic:"):
        return _known_deterministic(spec)
    path = find_checkpoint(spec, planner)
    args = path.parent / "args.json"
    if planner in _WITH_ARGS and args.is_file():
        return f"{file_hash(path)}+{file_hash(args)}"
    return file_hash(path)


def _inside(folder: Path) -> Path:
    """The checkpoint in a folder."""
    for name in _FILES:
        if (folder / name).is_file():
            return folder / name
    found = sorted(path for path in folder.iterdir() if path.suffix in SUFFIXES)
    if len(found) == 1:
        return found[0]
    names = ", ".join(path.name for path in found)
    what = f"folder {str(folder)!r} holds {len(found) or 'no'} checkpoints"
    raise CheckpointError(what, f"name one of them: {names}" if found else "give the file itself")


def _known_deterministic(spec: str) -> str:
    if spec not in DETERMINISTIC:
        hint = f"there are {' and '.join(DETERMINISTIC)}"
        raise CheckpointError(f"checkpoint {spec!r} unknown", hint)
    return spec


def require_torch(who: str) -> None:
    """Raise MissingExtraError, saying `who` needs it, where PyTorch is missing."""
    try:
        import torch  # noqa: F401  # to see whether it can be imported
    except ImportError as error:
        hint = "pip install 'shiftsim[learned]'"
        raise MissingExtraError(f"{who} needs PyTorch", hint) from error


def resolve_device(name: str) -> str:
    """`cpu` or `cuda:N`, of itself, `cuda` or `auto` (a GPU, else the CPU); else a ConfigError."""
    import torch

    kind, _, number = name.partition(":")
    if kind not in ("auto", "cpu", "cuda") or (number and (kind != "cuda" or not number.isdigit())):
        raise ConfigError(f"device {name!r} unknown", hint="use auto, cpu, cuda or cuda:N")
    count = torch.cuda.device_count() if kind != "cpu" and torch.cuda.is_available() else 0
    if kind == "cpu" or (kind == "auto" and count == 0):
        return "cpu"
    index = int(number or 0)
    if index >= count:
        what = f"device {name!r}: torch {torch.__version__} sees {count or 'no'} CUDA devices"
        raise ConfigError(what, "use --device cpu, or install a torch that fits the driver")
    return f"cuda:{index}"


def prepare_inference(device: str) -> None:
    """Make torch compute the same every time, on one thread; workers are what runs in parallel."""
    import torch

    torch.set_num_threads(1)
    if device == "cpu":
        return
    # read by cuBLAS when the first context is made; without it sums may change from run to run
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.backends.cudnn.benchmark = False
    torch.backends.cudnn.deterministic = True
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False
