"""Kinds of samplers, one a file, named after its ``type`` in scene files."""
