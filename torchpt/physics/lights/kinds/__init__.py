"""Lights that are no surfaces: one kind a file."""
