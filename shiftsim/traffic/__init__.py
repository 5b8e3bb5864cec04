"""How everything but the ego moves: replayed from the log, or reactive."""
