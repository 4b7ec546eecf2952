"""Where :mod:`warprrf.rf.paths.polarisation` stood before."""

from warprrf.rf.paths.polarisation import chain_reflection as chain_reflection
from warprrf.rf.paths.polarisation import turns as turns
