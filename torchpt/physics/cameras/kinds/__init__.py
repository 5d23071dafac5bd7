"""Cameras: one kind a file."""
