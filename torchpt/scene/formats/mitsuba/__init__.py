"""Read scene files of the Mitsuba renderer (XML, versions 0.3 to 3) into this program's scene format.

The way of a file: ``elements.py`` parses XML (``$name``, ``<include>``, limits) to :class:`~.elements.Element`; ``versions.py``
gives old names their present ones; ``properties.py`` and ``values.py`` read the values of an element; the tables of plugins
(``bsdfs.py textures.py shapes.py emitters.py sensors.py``) turn each into what this program has; ``importer.py`` puts a scene
together, in the form that YAML files have. ``notes.py`` collects the warnings. Start with ``importer.py``.

A :class:`~.plugins.Plugin` of a table says whether its twin is exact, the nearest that there is, or nothing; only the entry of
the table has to change where an exact twin is written later. ``docs/mitsuba.md`` has these tables.
"""

from torchpt.scene.formats.mitsuba.importer import ImportOptions, import_mitsuba, read_mitsuba, split_import_keys

__all__ = ["ImportOptions", "import_mitsuba", "read_mitsuba", "split_import_keys"]
