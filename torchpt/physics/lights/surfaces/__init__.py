"""Kinds of emissive surfaces, one kind of primitive a file."""
