"""Kinds of lights without a surface, one a file, named after its ``type`` in scene files."""
