# == paths ==
# line of sight, mirror paths and ways through slabs as a function of ends, orientations and materials
from warprrf.rf.paths.trace import trace_specular as trace_specular

# what it returns: gains, delays and angles over what is met, which Warp and torch differentiate
from warprrf.rf.paths.specular import SpecularPaths as SpecularPaths

# gains, delays and angles as they are answered
from warprrf.rf.paths.specular import PathValues as PathValues

# == totals and spectra ==
# slopes over positions of anything that is traced anew
from warprrf.rf.positions import retraced_slope as retraced_slope
