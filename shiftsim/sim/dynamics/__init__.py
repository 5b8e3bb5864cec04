"""Vehicle dynamics: kinematic bicycle, LQR tracker, perfect tracking."""
