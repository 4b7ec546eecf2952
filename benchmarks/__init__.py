"""Experiments and benchmarks: every table and figure of the README from one command each."""
