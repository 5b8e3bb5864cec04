"""Benchmarks: speed figures of this checkout, in `speed`."""

if __name__ == "benchmarks":  # pragma: no cover
    raise ImportError("import it as shiftsim.benchmarks")
