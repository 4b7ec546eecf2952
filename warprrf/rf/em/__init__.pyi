# == surfaces ==
# permittivity, thickness, roughness and scattering of a surface
from warprrf.rf.em.materials import Material as Material

# a material of ITU-R P.2040 by its name
from warprrf.rf.em.materials import itu_material as itu_material

# permittivity by frequency, one row of a material
from warprrf.rf.em.materials import Band as Band

# a table of materials from a JSON file
from warprrf.rf.em.materials import load_materials as load_materials

# scattering coefficient from roughness
from warprrf.rf.em.materials import roughness_scattering as roughness_scattering

# field reflected by a slab or half-space, TE and TM
from warprrf.rf.em.fresnel import slab_reflection as slab_reflection

# field that passes a slab, TE and TM
from warprrf.rf.em.fresnel import slab_transmission as slab_transmission

# scattering lobe, Lambertian or directive
from warprrf.rf.em.fresnel import lobe as lobe

# == air ==
# temperature, pressure and humidity: absorption by ITU-R P.676
from warprrf.rf.em.absorption import Air as Air

# specific attenuation at any frequency
from warprrf.rf.em.absorption import gas_attenuation_db_per_m as gas_attenuation_db_per_m

# == waves ==
# speed of light [m/s]
from warprrf.rf.em.waves import SPEED_OF_LIGHT as SPEED_OF_LIGHT

# phase that a delay gives a carrier
from warprrf.rf.em.waves import carrier_phase as carrier_phase
