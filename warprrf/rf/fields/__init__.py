"""Models of what receivers get, fitted to spectra: bistatic, and harmonic ones as published."""

from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.harmonic.field import HarmonicField

RadioField.models.update({"bistatic": BistaticField, "rf3dgs+": HarmonicField, "rf3dgs": HarmonicField})
