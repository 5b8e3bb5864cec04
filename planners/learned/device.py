"""Where a network runs, and that it computes the same every time."""

import os

from shiftsim.errors import ConfigError, MissingExtraError


def require_torch(who: str) -> None:
    """Raise MissingExtraError, saying `who` needs it, where PyTorch is missing."""
    try:
        import torch  # noqa: F401  # to see whether it can be imported
    except ImportError as error:
        raise MissingExtraError(
            f"{who} needs PyTorch", hint="pip install 'shiftsim[learned]'"
        ) from error


def resolve_device(name: str) -> str:
    """The device, `cpu` or `cuda:N`, of such a name, `cuda`, or `auto` (a GPU, else the CPU).

    Raises:
        ConfigError: The name is unknown, or this machine has no such device.
    """
    import torch

    kind, _, number = name.partition(":")
    if kind not in ("auto", "cpu", "cuda") or (number and (kind != "cuda" or not number.isdigit())):
        raise ConfigError(f"device {name!r} unknown", hint="use auto, cpu, cuda or cuda:N")
    count = torch.cuda.device_count() if kind != "cpu" and torch.cuda.is_available() else 0
    if kind == "cpu" or (kind == "auto" and count == 0):
        return "cpu"
    index = int(number or 0)
    if index >= count:
        raise ConfigError(
            f"device {name!r}: torch {torch.__version__} sees {count or 'no'} CUDA devices",
            hint="use --device cpu, or install a torch that fits the driver",
        )
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
