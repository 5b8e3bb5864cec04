"""Network definitions with the names and shapes of the official checkpoints; they need torch."""
