"""What a report is of: its runs, when and with which versions they were made, how to cite them."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from shiftsim.report.tables import Table
from shiftsim.runs.results import Run

_HASH = 12  # characters shown of a hash
_PACKAGES = ("python", "numpy", "numba", "torch")
CITED = "cite.bib"  # the file with the citation
_CITATION = """@misc{{shiftsim,
  author = {{{{shiftsim developers}}}},
  title = {{shiftsim: closed-loop evaluation of driving planners}},
  year = {{{year}}},
  note = {{version {version}}}
}}
@misc{{shiftdrift,
  author = {{Canevaro and others}},
  title = {{Shift \\& Drift: A Zero-Shot Benchmark for Generalizable and Robust Autonomous Driving
    Motion Planning}}
}}
@misc{{nuplan,
  author = {{Caesar, Holger and Kabzan, Juraj and Tan, Kok Seang and Fong, Whye Kit and Wolff, Eric
    and Lang, Alex and Fletcher, Luke and Beijbom, Oscar and Omari, Sammy}},
  title = {{{{nuPlan}}: A closed-loop {{ML}}-based planning benchmark for autonomous vehicles}},
  year = {{2021}},
  eprint = {{2106.11810}},
  archiveprefix = {{arXiv}}
}}"""


def citation(runs: Sequence[Run]) -> str:
    """BibTeX entries: shiftsim in the version of the runs, the benchmark's paper, nuPlan."""
    years = [_date(run)[:4] for run in runs]
    versions = dict.fromkeys(map(_version, runs))
    return _CITATION.format(year=max(years), version=", ".join(filter(None, versions)))


def made_of(runs: Sequence[Run]) -> str:
    """Runs, when they ended, and by which version of shiftsim, in one line."""
    dates = sorted(filter(None, map(_date, runs)))
    span = " to ".join(dict.fromkeys((*dates[:1], *dates[-1:])))
    versions = ", ".join(dict.fromkeys(filter(None, map(_version, runs))))
    names = ", ".join(run.path.name for run in runs)
    return " · ".join(filter(None, (f"runs: {names}", span, versions and f"shiftsim {versions}")))


def runs_table(runs: Sequence[Run]) -> Table:
    """A column per run: date, data with its hash, settings, weights, versions."""
    facts: dict[str, Callable[[Run], str]] = {
        "date": _date,
        "rollouts finished": lambda run: "{ok} of {expected}".format(**run.manifest["counts"]),
        "scenarios": lambda run: f"split {run.manifest['split']}",
        "store": lambda run: _store(run.manifest),
        "traffic": lambda run: run.manifest["determining"]["traffic"],
        "controller": lambda run: run.manifest["determining"]["controller"],
        "thresholds": lambda run: run.manifest["determining"]["thresholds"]["name"],
        "metrics": lambda run: f"v{run.manifest['determining']['metric_version']}",
        "planners": lambda run: ", ".join(run.manifest["config"]["planners"]),
        "weights": _weights,
        "noise": lambda run: ", ".join(run.manifest["config"]["noise"]),
        "seeds": lambda run: ", ".join(map(str, run.manifest["config"]["seeds"])),
        "shiftsim": _version,
        **{name: partial(_package, name=name) for name in _PACKAGES},
    }
    lines = ((name, *(fact(run) for run in runs)) for name, fact in facts.items())
    rows = tuple(line for line in lines if any(line[1:]))
    header = ("run", *(run.path.name for run in runs))
    return Table("runs", "The runs", header, rows, len(header))


def _date(run: Run) -> str:
    """When a run ended, to the minute, in UTC."""
    ended = str(run.manifest.get("ended") or run.manifest.get("started", ""))
    return f"{ended[:16].replace('T', ' ')} UTC" if ended else ""


def _version(run: Run) -> str:
    version, commit = _package(run, name="shiftsim"), run.manifest.get("git")
    return f"{version} ({commit})" if commit else version


def _package(run: Run, *, name: str) -> str:
    return str(run.manifest.get("versions", {}).get(name, ""))


def _store(manifest: dict[str, Any]) -> str:
    name = str(manifest["store"]).replace("\\", "/").rstrip("/").rpartition("/")[2]
    return f"{name}, {_short(manifest['determining']['store'])}"


def _short(text: str) -> str:
    """The beginning of a hash; other text as it is."""
    return text if ":" in text else text[:_HASH]


def _weights(run: Run) -> str:
    """What learned planners drove with: the label of the weights, or their hash."""
    planners = run.manifest["determining"]["planners"]
    found = {
        name: str(identity.get("weights") or _short(str(identity.get("checkpoint", ""))))
        for name, identity in planners.items()
        if isinstance(identity, dict)
    }
    return "; ".join(f"{name}: {words}" for name, words in found.items() if words)
