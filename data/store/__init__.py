"""Scenario stores: Parquet files with scenarios and maps."""
