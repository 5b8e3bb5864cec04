"""nuPlan's logs and maps, in both directions."""
