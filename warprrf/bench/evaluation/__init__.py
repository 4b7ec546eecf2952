"""The paper's evaluation side by side: every method, honest protocol, resumable runs, one machine or many."""

from warprrf.bench.evaluation.command import run
from warprrf.bench.evaluation.report import markdown

__all__ = ["markdown", "run"]
