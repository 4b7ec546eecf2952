"""Fuzzing: every public function's arguments and every file format, mutated and tried in processes that may crash.

``values`` are what arguments and contents of files are replaced with, ``calls`` a working example of every public call,
``formats`` one of every file and how it is read, ``damage`` what is done to files. ``cases`` names what is tried, so that
it can be repeated; ``workers`` tries it, ``judge`` says what is wrong. `python -m benchmarks fuzz` runs for as long as
it is told to; ``tests/fuzz`` runs a part of the same cases.
"""
