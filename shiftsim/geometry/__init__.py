"""Kernels that two subsystems need, each once: boxes, rings, polylines, frames."""
