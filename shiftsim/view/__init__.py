"""Replay: rollouts of one scenario as one HTML page that needs no server and no network."""
