"""Read scene files: YAML, composition, overrides, validation; the result is a :class:`~.description.Description`.

Read ``description.py`` first: it calls ``yaml.py`` (parses text), ``compose.py`` (merges the files in ``defaults``),
``overrides.py`` (changes single keys) and the readers of blocks. ``mitsuba/`` makes a scene of that form from
Mitsuba's XML, and ``write.py`` writes one as a file. No file other than scene files is opened here, but for spectra
and meshes that an imported scene has in another way than their file.
"""
