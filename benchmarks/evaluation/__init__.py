"""The paper's evaluation side by side: every method, honest protocol, resumable runs, one machine or many."""

from benchmarks.evaluation.command import run
from benchmarks.evaluation.report import markdown

__all__ = ["markdown", "run"]
