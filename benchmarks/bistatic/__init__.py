"""The bistatic field beside other systems: one resumable command that makes the whole table of its evaluation."""

from benchmarks.bistatic.report import summary_text, write
from benchmarks.bistatic.table import run

__all__ = ["run", "summary_text", "write"]
