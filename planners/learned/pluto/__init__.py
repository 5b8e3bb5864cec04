"""PLUTO."""
