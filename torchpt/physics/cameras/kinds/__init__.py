"""Kinds of cameras, one a file, named after its ``type`` in scene files."""
