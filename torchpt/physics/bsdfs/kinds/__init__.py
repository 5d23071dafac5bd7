"""Materials: one model a file."""
