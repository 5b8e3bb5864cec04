"""Many rollouts: settings, tasks, workers, and the folder of a run."""
