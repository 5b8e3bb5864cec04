"""Placeholder until the sub-package is filled."""

if __name__ == "metrics":  # pragma: no cover
    raise ImportError("import it as shiftsim.metrics")
