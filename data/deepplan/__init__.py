"""DeepPlan's conversion of aerial recordings."""
