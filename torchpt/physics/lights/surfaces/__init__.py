"""Surfaces that emit: one kind of primitive a file."""
