"""Routes: blocks corrected, lanes along them, and the searches both need."""
