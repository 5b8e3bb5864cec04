"""One rollout: the closed loop, what it asks of planners, noise, dynamics, traffic."""
