"""The scene file: YAML, fields, validation, and the description that they come to."""
