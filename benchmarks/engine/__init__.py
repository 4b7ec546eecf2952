"""The engine's benchmarks: each knob's speed against error, growth, mesh rays, blending, transport on disk."""

from benchmarks.engine.report import summary_text, write
from benchmarks.engine.table import QUICK, Sizes, run_engine

__all__ = ["QUICK", "Sizes", "run_engine", "summary_text", "write"]
