"""Benchmarks, run as ``python -m bench NAME`` from the repository; ``python -m bench --list`` shows them.

A benchmark is one file ``bench/NAME.py``: a docstring whose first line says what it measures, ``COLUMNS`` (the keys
shown in the table, in order), and a generator ``rows(*, device: str, quick: bool)`` that yields one dict per table row.
A row may hold more keys than ``COLUMNS``; all of them go into the JSON. Peers and other heavy packages are imported
inside ``rows``.
"""
