"""What `warprrf COMMAND --help` says besides the options: a sentence where one is needed, and examples."""

HELP_LOBBY = """\
Continues where a killed run stopped; each stage is redone only if its inputs or its code changed. Writes report.html,
report.json (every figure), geometry.ply (Gaussians, opens in any splat viewer), mesh.ply, field.safetensors and
cameras.json. About 15 minutes on two cores, no GPU.

examples:
  warprrf lobby
  warprrf lobby --reduced --out runs/quick        few photos and steps, to see it run
"""

HELP_RECONSTRUCT = """\
The photos go through structure from motion (SIFT, matching, mapping), then Gaussians are optimised against them and
their depth is fused into a mesh. Photos know no scale: name the measured positions of at least three cameras.

examples:
  warprrf reconstruct photos/ -o room --known-positions surveyed.json
  where surveyed.json holds {"view_000.jpg": [1.20, 0.85, 1.60], ...} in metres
Overlap matters most: every surface in five photos or more, loops that look across the room.
"""

HELP_SIMULATE = """\
`exact` evaluates line of sight, mirror reflections and one diffuse bounce without sampling noise, on Warp's mesh rays.
`sionna` asks Sionna RT's PathSolver (extra: sionna) for line of sight, mirror and diffuse paths up to --depth.
A killed run continues: finished receivers wait in OUT.receivers/. An eighth of the receivers is marked for test.
A spectrum is path gain per pixel over the full sphere, spread by the receiver beam; its sum is the total path gain.

examples:
  warprrf simulate data/lobby/scene.xml -o one.nc --transmitter 2 3 3.2 --receivers 7,4,1.5 9,4,1.5
  warprrf simulate data/lobby/scene.xml -o many.nc --transmitter 2 3 3.2 --receivers receivers.csv --engine sionna
"""

HELP_FIT = """\
Geometry stays frozen; blending weights are computed once per receiver, then the radio part is fitted on them.

  bistatic  line of sight, mirrors and scattering lobes of material groups; holds for other transmitters too
  rf3dgs+   directional gain per Gaussian times the path-length law; delay and departure angle from geometry
  rf3dgs    directional gain without lengths; delay and departure angle as trained channels of their own

examples:
  warprrf fit room spectra.nc -o field.safetensors
  warprrf fit splats.ply spectra.nc --mesh mesh.ply -o field.safetensors --model rf3dgs --train 50
"""

HELP_RELEVANCE = """\
Each effect is left out of the full model in turn: line of sight, mirrors, diffuse bounces, lobes, what no receiver
sees, and, as estimates, the air, diffraction and transmission. What it is worth is the larger of the changes of the dB
image and of the total path gain, rms over receivers. The smallest model within the tolerance follows; a fit can use it.

examples:
  warprrf relevance data/lobby/scene.xml --spectra data/lobby/spectra.nc -o relevance.json
  warprrf relevance data/lobby/scene.xml --transmitter 2 3 3.2 --receivers 7,4,1.5 9,4,1.5 --frequency 140e9
  warprrf relevance field.safetensors --receivers receivers.csv --tolerance 0.5
  warprrf fit room spectra.nc -o field.safetensors --relevance relevance.json
"""

HELP_RENDER = """\
examples:
  warprrf render field.safetensors --receiver 7 4 1.5 -o spectrum.png
  warprrf render field.safetensors --receiver 7 4 1.5 -o spectrum.npz       path_gain, delay_s, aod as arrays
  warprrf render room/geometry.ply --position 2 2 1.6 --look-at 8 6 1.2 -o view.png
"""

HELP_EVALUATE = """\
Whole receivers are held out, the same for every method; beside the field stand lookups that know no geometry (nearest
measurement, inverse distance, a constant, the mean image). `blocked` counts receivers without line of sight alone.

examples:
  warprrf evaluate field.safetensors spectra.nc --train 50 -o figures.json
"""

HELP_MAP = """\
Total path gain, the strongest path's gain, delay spread and the SNR of the receiver's best beam, at the centres of
cells; NaN inside solids and outside the room, as the field's mesh has them. A NetCDF file gets a picture beside it.

examples:
  warprrf map field.safetensors -o map.nc --height 1.5 --cell 0.25
  warprrf map field.safetensors -o corner.png --bounds 0 0 5 4 --cell 0.1 --transmitter 2 3 3.2
"""

HELP_TWIN = """\
Writes the reconstructed mesh with the fitted materials as scene.xml, materials.json and meshes/. `sionna.rt.load_scene`
opens the scene as it is, all lobes Lambertian; `warprrf.load_sionna_scene` sets the scattering patterns too, and
`warprrf simulate` takes it as any scene. A material has one curve and one lobe: what the projection misses is printed.

examples:
  warprrf twin field.safetensors -o twin
  warprrf simulate twin/scene.xml -o spectra.nc --transmitter 2 3 3.2 --receivers receivers.csv --engine sionna
"""

HELP_BENCH = """\
Prints a table and writes it as JSON and Markdown.

examples:
  warprrf bench channel
  warprrf bench relevance
  warprrf bench newrf
  warprrf bench newrf --data external/newrf --out runs/newrf
  warprrf bench bistatic --truths exact --counts 10 50
  warprrf bench engine
  warprrf bench map --field field.safetensors
  warprrf bench table1
  warprrf bench sparsity
  warprrf bench beams
"""

HELP_BENCH_BISTATIC = """\
Fits the bistatic field, RF-3DGS+ and lookups on the same receivers and scores them on held-out ones; then ablation,
stated uncertainty, delays, a second transmitter, Sionna against itself, Gauss-Newton against Adam. Every row is kept:
a killed run loses one, and a row is made again only if its data, geometry, options or code changed.

examples:
  warprrf bench bistatic
  warprrf bench bistatic --truths exact --counts 10 --every 4 --out runs/quick     a first look, in minutes
  warprrf bench bistatic --data spectra_full.nc spectra_sionna_full.nc --geometry room
"""

HELP_BENCH_ENGINE = """\
Turns each knob of the rasteriser (cutoff, clamp, top K, precision, resolution, number of Gaussians, interaction point,
form of the response and of the exponential) and writes its time and its error as tables and pictures, with the settings
that follow; then growth, mesh rays against Embree, blending against torch, and the transport of 800 receivers on disk.
--opensplat adds the CPU rasteriser of https://github.com/pierotofy/OpenSplat (AGPL), compiled from your own checkout.
Each measurement is kept: a killed run loses one. For figures worth quoting leave the machine alone meanwhile.

examples:
  warprrf bench engine
  warprrf bench engine --quick --out runs/engine-quick
  warprrf bench engine --opensplat ../OpenSplat
"""

HELP_BENCH_EVALUATION = """\
Every method on the same receivers: bistatic, RF-3DGS+ and RF-3DGS (opacity frozen and trained), NeRF2, a conditional
GAN, Sionna RT with assumed and with calibrated materials, lookups. Both commands share one folder: a finished run is
kept in a file of its own, a killed sweep loses the run at work, and a run is done again only if its data, geometry,
options or code changed. The truth `paper-law` is made: scattering that falls with the whole path's length, as the
paper's law has it. Needs the extras plots, baselines, sionna and cluster; --workers 0 does without the last.

examples:
  warprrf bench table1
  warprrf bench sparsity --workers 0
  warprrf bench table1 --methods bistatic rf3dgs+ rf3dgs --counts 10 --every 10      a first look, in minutes
  warprrf bench table1 --scale paper --data spectra_full.nc spectra_sionna_full.nc --scheduler tcp://lab:8786
"""

HELP_BENCH_BEAMS = """\
Fits the bistatic field and RF-3DGS+, picks each test receiver's beam without pilots, and compares received SNR and
spectral efficiency on the true channel with exhaustive and hierarchical search, the nearest training receiver's beam,
pointing at the transmitter, zero spectra and random beams. Fitted fields are kept: a killed run continues.

examples:
  warprrf bench beams
  warprrf bench beams --truths exact --counts 10 --every 4 --sides 4 16 --out runs/quick     a first look
  warprrf bench beams --data spectra_full.nc spectra_sionna_full.nc --geometry room
"""

HELP_DATA = """\
Builds the scene (meshes, textures, materials), renders the photos with Mitsuba and simulates the spectra with both
engines; needs the extras photos and sionna, and an LLVM of at least 17 for Dr.Jit. Finished photos and receivers are
kept, so that a killed run continues.

examples:
  warprrf data
  warprrf data --only spectra
"""
