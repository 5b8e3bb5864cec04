"""The version of shiftsim."""

__version__ = "0.1.0"
