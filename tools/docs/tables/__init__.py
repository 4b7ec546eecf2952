"""Tables of the documentation, from the files in ``benchmarks/results``; each is a function under its name."""

from tables import engine, links, lobby, measurements, paper, running
from tables.common import TABLES, table

__all__ = ["TABLES", "engine", "links", "lobby", "measurements", "paper", "running", "table"]
