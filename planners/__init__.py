"""Placeholder until the sub-package is filled."""

if __name__ == "planners":  # pragma: no cover
    raise ImportError("import it as shiftsim.planners")
