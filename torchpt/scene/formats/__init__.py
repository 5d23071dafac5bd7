"""Read scene files: YAML, composition, overrides, validation; the result is a :class:`~.description.Description`."""
