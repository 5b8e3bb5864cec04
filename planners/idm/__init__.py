"""nuPlan's IDM planner."""
