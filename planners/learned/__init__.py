"""Adapters of learned planners, and what they share."""
