"""Kinds of textures, one a file, named after its ``type`` in scene files."""
