"""Beams chosen from the field, beside pilots and other systems, on the true channel: SNR and spectral efficiency."""

from benchmarks.beams.report import summary_text, write
from benchmarks.beams.run import run_beams

__all__ = ["run_beams", "summary_text", "write"]
