"""The command line: what each command of ``torchpt`` does, its arguments being plain values.

``main.py`` has the table of commands and is all that imports Hydra: start there. One command a file: ``render.py``,
``converge.py``, ``compare.py``, ``info.py``, ``stress.py``, ``orbit.py``, ``debug.py``; the others serve them all.

May import: all that lies below.
"""
