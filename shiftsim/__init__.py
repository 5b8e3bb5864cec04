"""Closed-loop evaluation of driving planners with nuPlan's semantics."""

__version__ = "0.1.0"
