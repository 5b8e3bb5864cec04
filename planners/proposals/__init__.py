"""What PDM-Closed and PLUTO share to score proposals."""
