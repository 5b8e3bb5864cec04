"""Planners by name; see `registry`."""

if __name__ == "planners":  # pragma: no cover
    raise ImportError("import it as shiftsim.planners")
