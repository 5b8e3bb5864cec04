"""Planners by name; see `registry`."""

from shiftsim._moved import moved_names

__getattr__ = moved_names(__name__)

if __name__ == "planners":  # pragma: no cover
    raise ImportError("import it as shiftsim.planners")
