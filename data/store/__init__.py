"""Scenario stores: Parquet files with scenarios and maps."""

from shiftsim._moved import moved_names

__getattr__ = moved_names(__name__)
