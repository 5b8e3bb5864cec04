"""Placeholder until the sub-package is filled."""

if __name__ == "data":  # pragma: no cover
    raise ImportError("import it as shiftsim.data")
