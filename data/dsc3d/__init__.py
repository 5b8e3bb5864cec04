"""Recordings in the format of DSC3D."""
