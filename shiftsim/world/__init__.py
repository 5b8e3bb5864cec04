"""What exists: states, maps, layers of a map, scenarios."""
