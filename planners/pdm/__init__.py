"""PDM-Closed."""
