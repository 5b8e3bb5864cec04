"""Generated towns and their recordings."""
