"""Fuzzing: every public function's arguments and every file format, mutated and tried in processes that may crash.

``place`` is what is tried, ``calls`` a working example of every public call, ``values`` what its arguments are replaced
with, ``files`` one of every file, how it is read and what is done to it. ``trial`` tries a case and judges what came of
it, in ``workers``. ``python -m tests.fuzz --minutes 60`` runs for as long as it is told to; ``make test`` some of it.
"""
