"""Diffusion Planner."""
