"""Results of nuPlan's own simulation against ours, and the self-check of `shiftsim doctor`."""
