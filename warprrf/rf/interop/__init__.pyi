# == Sionna RT ==
# a scene opened in Sionna RT with its materials and scattering patterns
from warprrf.rf.interop.sionna_engine import load_sionna_scene as load_sionna_scene

# a field's mesh and fitted materials as a scene
from warprrf.rf.interop.twin import write_twin as write_twin

# what `write_twin` wrote, and what no material can hold
from warprrf.rf.interop.twin import Twin as Twin

# paths in Sionna RT's shapes (`Paths.to_sionna`)
from warprrf.rf.paths.sionna import SionnaPaths as SionnaPaths

# an antenna array of Sionna RT's, custom patterns included
from warprrf.rf.scene_sionna import array_from_sionna as array_from_sionna

# choose an LLVM that Dr.Jit can use
from warprrf.rf.scene_sionna import select_llvm as select_llvm

# == files ==
# paths as a DeepMIMO scenario
from warprrf.rf.interop.deepmimo import write_deepmimo as write_deepmimo
