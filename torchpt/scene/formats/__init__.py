"""Read scene files: YAML, composition, overrides, validation; the result is a :class:`~.description.Description`.

Read ``description.py`` first: it calls ``yaml.py`` (parses text), ``compose.py`` (merges the files in ``defaults``),
``overrides.py`` (changes single keys) and the readers of blocks. No file other than scene files is opened here.
"""
