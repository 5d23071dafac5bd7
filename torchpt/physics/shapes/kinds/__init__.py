"""Kinds of shapes, one a file, named after its ``type`` in scene files."""
