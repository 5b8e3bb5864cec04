"""Does this installation work: versions, memory, and kernels against values of nuPlan's own code.

The few reference values that come with the package are compared by the code that `shiftsim verify`
uses for whole folders of them.
"""

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import shiftsim.verify
from shiftsim.arrays import cache_folder
from shiftsim.runs.config import default_workers

REFERENCE = Path(shiftsim.verify.__file__).parent / "reference"

Advance = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    Attributes:
        versions: Of Python and the packages that matter.
        torch: What learned planners would run on.
        cores: Cores this process may use.
        memory: Memory of the machine [bytes], 0 where unknown.
        workers: Suggested number of worker processes.
        kernel_cache: Folder of compiled kernels, empty for the default.
        seconds: How long the checks took, compilation included [s].
        cases: Reference values compared.
        mismatches: Those that differ, in words.
    """

    versions: dict[str, str]
    torch: str
    cores: int
    memory: int
    workers: int
    kernel_cache: str
    seconds: float
    cases: int
    mismatches: tuple[str, ...]

    @property
    def is_well(self) -> bool:
        """Whether results can be trusted."""
        return self.cases > 0 and not self.mismatches

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)

    def lines(self) -> list[str]:
        """As text."""
        packages = "  ".join(f"{name} {version}" for name, version in self.versions.items())
        memory = f"{self.memory / 1e9:.1f} GB memory" if self.memory else "memory unknown"
        equal = self.cases - len(self.mismatches)
        return [
            f" {packages}",
            f" torch: {self.torch}",
            f" {self.cores} cores, {memory}, suggested workers {self.workers}",
            f" kernel cache: {self.kernel_cache or 'next to the source'}",
            f" reference checks {equal}/{self.cases} equal in {self.seconds:.1f} s",
            *(f" MISMATCH {line}" for line in self.mismatches[:20]),
        ]


def examine(advance: Advance = lambda done, total, note: None) -> Diagnosis:
    """Examine this installation; compiles the kernels that are not in the cache yet."""
    from shiftsim.runs.manifest import versions
    from shiftsim.verify import verify
    from shiftsim.verify.warmup import warm_up

    began = perf_counter()
    reports = []
    # the metrics take longest to compile; their processes have the time of everything before them
    with warm_up("routes", "contacts"):
        advance(0, 3, "torch")
        torch = _torch()
        advance(1, 3, "dynamics")
        reports.append(verify(REFERENCE / "dynamics"))
        advance(2, 3, "metrics")
    reports.append(verify(REFERENCE / "metric_worlds"))
    advance(3, 3, "")
    return Diagnosis(
        versions=versions(),
        torch=torch,
        cores=default_workers(memory_each=1.0),
        memory=_memory(),
        workers=default_workers(),
        kernel_cache=cache_folder(),
        seconds=perf_counter() - began,
        cases=sum(report.num_cases for report in reports),
        mismatches=tuple(line for report in reports for line in report.mismatches),
    )


def _memory() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return 0


def _torch() -> str:
    try:
        import torch
    except ImportError:
        return "not installed (learned planners: pip install 'shiftsim[learned]')"
    if not torch.cuda.is_available():
        return f"{torch.__version__}, no CUDA device"
    names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return f"{torch.__version__}, CUDA {torch.version.cuda}: {', '.join(names)}"
