"""Planners of a few lines."""
