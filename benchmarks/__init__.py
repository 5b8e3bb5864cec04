"""Placeholder until the sub-package is filled."""

if __name__ == "benchmarks":  # pragma: no cover
    raise ImportError("import it as shiftsim.benchmarks")
