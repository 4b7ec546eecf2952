"""What fields are fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from warprrf.rf.channel.array_spectra import ArraySpectra
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import Readings

Measured: TypeAlias = SpectrumDataset | Readings | ArraySpectra
"""A set of spectra, a table of readings, spectra of coherent arrays."""
Data: TypeAlias = Measured | Sequence[Measured]
"""One of them, or several."""
