"""PlanTF."""
