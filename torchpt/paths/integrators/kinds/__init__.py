"""The integrators, one a file."""
