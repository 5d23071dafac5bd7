"""Studies: many renders, what they come to, and the page that shows it.

``study.py`` has the settings and the grid of a study: start there. ``runs.py`` takes the times and resumes, ``analysis.py``
says what runs come to, with ``statistics.py``; ``page.py``, ``plots.py`` and ``report.py`` show it.

May import: ``rendering`` and what lies below.
"""
