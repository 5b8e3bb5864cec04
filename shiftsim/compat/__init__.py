"""Planners written against other simulators' interfaces."""
