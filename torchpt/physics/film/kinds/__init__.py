"""Kinds of reconstruction filters, one a file, named after its ``type`` in scene files."""
