"""Kinds of textures: one a file."""
