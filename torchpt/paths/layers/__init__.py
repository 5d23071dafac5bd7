"""The layers of a picture, one a file."""
