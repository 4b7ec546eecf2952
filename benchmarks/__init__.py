"""Experiments on warprrf: every table and figure from one command each, ``python -m benchmarks NAME``."""
