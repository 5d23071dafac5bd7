"""Samplers: one kind a file."""
