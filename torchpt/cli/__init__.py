"""The commands of ``torchpt``.

Start with ``main.py``: it holds the table of commands and runs Hydra. Each command has a file: ``render.py``, ``converge.py``,
``compare.py``, ``info.py``, ``stress.py``, ``orbit.py``, ``debug.py``. The other files are shared by several commands.

May import: every other package.
"""
