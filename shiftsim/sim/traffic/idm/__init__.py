"""Reactive traffic: nuPlan's IDM agents."""
