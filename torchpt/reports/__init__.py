"""Studies: error over time of a grid of settings, against a reference, as a report.

``study.py`` reads the settings and the grid of a study: start there. ``runs.py`` renders and times the runs, and resumes;
``analysis.py`` computes errors, slopes and bias, with ``statistics.py``; ``page.py``, ``plots.py`` and ``report.py`` write
the report.

May import: ``rendering`` and what lies below.
"""
