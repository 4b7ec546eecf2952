"""The engine's benchmarks: each knob's speed against error, growth, mesh rays, blending, transport on disk."""

from warprrf.bench.engine.report import summary_text, write
from warprrf.bench.engine.table import QUICK, Sizes, run_engine

__all__ = ["QUICK", "Sizes", "run_engine", "summary_text", "write"]
