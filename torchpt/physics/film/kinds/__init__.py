"""Reconstruction filters: one kind a file."""
