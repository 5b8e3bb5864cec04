"""CaRL."""
