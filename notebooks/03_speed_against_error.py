# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Speed against error: what each knob costs and buys
#
# Every knob of the library trades time for error. This notebook turns them one at a time and draws both, on sizes small
# enough for a minute; `python -m benchmarks engine` and `python -m benchmarks map` do the same on sizes worth quoting.
#
# 1. [The rasteriser](#raster): cutoff, weights kept per pixel, resolution
# 2. [Rays per pixel](#rays) of a field
# 3. [The grid of a spectrum](#grid)
# 4. [How many bounces](#bounces): mirrors and diffuse bounces
# 5. [Rays per cell](#map) of a radio map
# 6. [What follows](#follows)
#
# Read each picture from the lower left: cheap and right. A knob is worth turning as long as the curve falls, and only
# down to the error that something else makes anyway: a mesh that is wrong by centimetres, materials known to a decibel.
# Times are those of this machine and of small problems; the order of the points is what carries over.

# %%
import time
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib_inline.backend_inline import set_matplotlib_formats

import warprrf as wr

DATA = next(p / "data/lobby" for p in [Path.cwd(), *Path.cwd().parents] if (p / "data/lobby").is_dir())
set_matplotlib_formats("png")
plt.rcParams.update({"figure.dpi": 70, "figure.constrained_layout.use": True})
clock = time.perf_counter()


def seconds_of(run, repeats=2):
    """Shortest time of `run` after one that loads kernels, and what it returned."""
    result, times = run(), []
    for _ in range(repeats):
        start = time.perf_counter()
        result = run()
        times.append(time.perf_counter() - start)
    return min(times), result


def curve(ax, rows, error, label, colour="#0b6e99"):
    """Time against error of `rows`, each point labelled with the knob's value; errors below 1e-4 dB are left out."""
    shown = [r for r in rows if r[error] > 1e-4]
    ax.loglog([1e3 * r["seconds"] for r in shown], [r[error] for r in shown], "o-", color=colour, label=label)
    for r in shown:
        ax.annotate(
            str(r["value"]), (1e3 * r["seconds"], r[error]), (5, 4), textcoords="offset points", fontsize=8
        )
    if ax.get_xlim()[1] < 6 * ax.get_xlim()[0]:
        ax.set_xscale("linear")
    ax.set_xlabel("time [ms]"), ax.grid(alpha=0.3, which="both")


# %% [markdown]
# <a id="raster"></a>
# ## 1. The rasteriser
#
# A Gaussian adds to a pixel with its opacity times its response on the pixel's ray, and blending front to back stops
# when little light is left. Two cutoffs make that fast: contributions below `alpha_min` are skipped, and a ray ends
# when its transmittance falls below `transmittance_min`. For photos 1/255 is enough, because a pixel has 8 bits. A
# radio image is 60 dB deep: what is skipped there would be visible, so its cutoffs follow from the noise floor.
#
# *Top K* is how many Gaussians a pixel keeps for the fit: it costs memory more than time (where times scatter, it is
# the machine's other work). The last panel is the grid: its error is that of reading the
# image at the nearest pixel, so it is a property of the picture, not of the method.

# %%
rng = np.random.default_rng(0)
size = np.array([18.0, 12.0, 4.0])  # a room [m], covered by flat Gaussians
wall = rng.integers(0, 6, 3_000)
means = rng.uniform(0, 1, (3_000, 3)) * size
means[np.arange(3_000), wall % 3] = (wall < 3) * size[wall % 3]
scales = rng.uniform(0.2, 0.6, (3_000, 3))
scales[np.arange(3_000), wall % 3] = 0.02
room = wr.Gaussians(
    means, np.tile([1.0, 0, 0, 0], (3_000, 1)), scales, rng.uniform(0.3, 0.95, 3_000), np.zeros((3_000, 1, 3))
)
gains = 10 ** ((-35 + 15 * np.sin(1.3 * means[:, 0]) * np.cos(1.7 * means[:, 1])) / 10)
RADIO = wr.splats.Blending(alpha_min=1e-4, alpha_max=1 - 1e-6, transmittance_min=1e-7)


def panorama(shape):
    return wr.Camera.spherical(shape[1], shape[0], position=(7.0, 5.0, 1.5))


def image(alpha_min=1e-4, shape=(30, 60)):
    blending = replace(RADIO, alpha_min=alpha_min)
    return wr.render(room, panorama(shape), features=gains[:, None], blending=blending).features[..., 0]


def error_db(found, truth):
    floor = truth.max() * 1e-6
    return np.sqrt(np.mean((10 * np.log10((found + floor) / (truth + floor))) ** 2))


def rows_of(values, make, truth, shown=str):
    rows = []
    for value in values:
        seconds, found = seconds_of(lambda value=value: make(value))
        rows.append({"value": shown(value), "seconds": seconds, "error_rms_db": error_db(found, truth)})
    return rows


def of_strongest(k):
    """The image of the strongest `k` Gaussians of each pixel."""
    found = wr.splats.blend_weights(room, panorama((30, 60)), top_k=k, blending=RADIO)
    return (found.weight * np.where(found.index >= 0, gains[found.index], 0)).sum(axis=-1)


fine = image(shape=(120, 240))


def nearest_pixel(shape):
    """A coarse image read at the pixels of a fine one."""
    found = image(shape=shape)
    return found[np.ix_(np.arange(120) * shape[0] // 120, np.arange(240) * shape[1] // 240)]


cutoff = rows_of((1e-2, 1 / 255, 1e-3, 1e-4, 1e-5), image, image(1e-8), "{:.0e}".format)
kept = rows_of((1, 2, 4, 8, 16, 32), of_strongest, of_strongest(256))
grid = rows_of(((15, 30), (30, 60), (60, 120)), nearest_pixel, fine, lambda s: "{} x {}".format(*s))
figure, axes = plt.subplots(1, 3, figsize=(14, 3.6))
for ax, rows, title in zip(axes, (cutoff, kept, grid), ("alpha_min", "top K", "grid"), strict=True):
    curve(ax, rows, "error_rms_db", title)
    ax.set_title(title)
axes[0].set_ylabel("rms error of the dB image [dB]")
plt.show()

# %% [markdown]
# <a id="rays"></a>
# ## 2. Rays per pixel
#
# A bistatic field evaluates scattering along a lattice of rays in every pixel. More rays make edges and shadows
# sharper; nothing else changes. The error below is that of the dB image of a whole query (60 x 120 pixels, rays traced
# from nothing, beam and delays included) against 64 rays a pixel. Since rays lie in a lattice and not at random, it
# falls faster than one over the square root of their number.
#
# A field knows its materials and its mesh less well than that, so few rays do: a fit takes 9, `sub_pixels=3`, and
# `RadioField.fit(..., quick=True)`, as here, takes one, and holds no receiver out to choose effects by.

# %%
scene = wr.Scene.load(DATA / "scene.xml")
dataset = wr.SpectrumDataset.load(DATA / "spectra.nc")
seen, blocked = (dataset.receivers[dataset.line_of_sight == flag] for flag in (True, False))
places = np.concatenate([seen[:2], blocked[:2]])
start = time.perf_counter()
field = wr.RadioField.fit(scene, dataset.split(10)[0], quick=True)
print(f"fitted to ten spectra in {time.perf_counter() - start:.1f} s: {field.effects}")


def with_effects(**changed):
    """The same field with other effects."""
    return replace(field, effects=replace(field.effects, **changed))


def images(sub_pixels):
    """Time of a query, and the dB images at all places."""
    finer = replace(field, sub_pixels=sub_pixels)
    seconds, found = seconds_of(lambda: [finer.spectrum(p).path_gain_db for p in places])
    return seconds / len(places), np.array(found)


truth_db = images(8)[1]
queries = []
for n in (1, 2, 3, 4, 6):
    seconds, found = images(n)
    queries.append({"value": n * n, "seconds": seconds, "error": np.sqrt(np.mean((found - truth_db) ** 2))})
    print(f"{n * n:3d} rays a pixel: {1e3 * seconds:6.1f} ms a query, {queries[-1]['error']:.3f} dB")
figure, ax = plt.subplots(figsize=(6, 3.4))
curve(ax, queries, "error", "rays per pixel", "#b3123c")
ax.set_ylabel("rms error of the dB image [dB]")
plt.show()

# %% [markdown]
# <a id="grid"></a>
# ## 3. The grid of a spectrum
#
# The total path gain hardly depends on the grid, since every path's power is kept when the receiver's beam spreads it.
# What a coarse grid loses is *where* power comes from: the strongest pixel's centre lies up to half a pixel's diagonal
# from the strongest path (8, 4 and 2 degrees here; five places, so chance plays a part). Half the pixel width costs four
# times the pixels.

# %%
near = seen[:5]
toward = dataset.transmitter - near
toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
rows = []
for shape in ((15, 30), (30, 60), (60, 120)):
    coarse = replace(field, shape=shape)
    seconds, spectra = seconds_of(lambda coarse=coarse: [coarse.spectrum(p) for p in near], repeats=1)
    angle = []
    for spectrum, direction in zip(spectra, toward, strict=True):
        i, j = np.unravel_index(spectrum.path_gain.argmax(), shape)
        zenith, azimuth = (i + 0.5) * np.pi / shape[0], -np.pi + (j + 0.5) * 2 * np.pi / shape[1]
        found = [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)]
        angle.append(np.degrees(np.arccos(np.clip(direction @ found, -1, 1))))
    rows.append(
        {
            "shape": shape,
            "seconds": seconds / len(near),
            "degrees": np.mean(angle),
            "gain": [10 * np.log10(s.total_path_gain) for s in spectra],
        }
    )
for row in rows:
    change = np.abs(np.subtract(row["gain"], rows[-1]["gain"])).max()
    print(
        f"{row['shape'][0]:3d} x {row['shape'][1]:3d}: {1e3 * row['seconds']:6.1f} ms, strongest pixel "
        f"{row['degrees']:.2f} degrees from the line of sight, total path gain off by {change:.3f} dB"
    )

# %% [markdown]
# <a id="bounces"></a>
# ## 4. How many bounces
#
# With line of sight, everything else is a small correction. Behind a corner it is all there is. Each row adds an effect
# to the field before; what it changes is the total path gain, at places that see the transmitter and at places that do
# not. (Materials are those of a quick fit without these effects, so this is about what effects are worth, not the truth.
# `warprrf.relevance` asks the same question of a scene and answers with the smallest model within a tolerance.)

# %%
alone = {"mirror_scatter": False, "scatter_mirror": False}
steps = {
    "line of sight": {**alone, "mirrors": 0, "scatterings": 0},
    "+ one mirror": {**alone, "mirrors": 1, "scatterings": 0},
    "+ two mirrors": {**alone, "mirrors": 2, "scatterings": 0},
    "+ three mirrors": {**alone, "mirrors": 3, "scatterings": 0},
    "+ scattering": {**alone, "mirrors": 3, "scatterings": 1},
    "+ mirrors light surfaces": {"scatter_mirror": False, "mirrors": 3, "scatterings": 1, "mirror_scatter": True},
    "+ scattering twice": {"scatter_mirror": False, "mirrors": 3, "scatterings": 2, "mirror_scatter": True},
}  # fmt: skip
groups = {"seen": seen[:6], "blocked": blocked[:6]}
gains, times = [], []
for effects in steps.values():
    model = with_effects(**effects)
    model.links(places[:1])  # what belongs to the transmitter is traced once
    totals = {}
    start = time.perf_counter()
    for group, where in groups.items():
        totals[group] = 10 * np.log10(np.maximum(model.links(where).total_path_gain, 1e-15))
    times.append((time.perf_counter() - start) / 12)
    gains.append(totals)
print(f"{'model':<26}{'ms a place':>11}{'seen':>10}{'blocked':>10}   mean total path gain [dB]")
for name, totals, spent in zip(steps, gains, times, strict=True):
    print(f"{name:<26}{1e3 * spent:>11.1f}{totals['seen'].mean():>10.2f}{totals['blocked'].mean():>10.2f}")

figure, ax = plt.subplots(figsize=(8, 3.4))
for group, colour in (("seen", "#c9a227"), ("blocked", "#0b6e99")):
    left = [np.sqrt(np.mean((totals[group] - gains[-1][group]) ** 2)) for totals in gains[:-1]]
    ax.semilogy(list(steps)[:-1], np.maximum(left, 1e-4), "o-", color=colour, label=group)
ax.set_ylabel("rms change still to come [dB]"), ax.grid(alpha=0.3), ax.legend()
ax.tick_params(axis="x", rotation=20)
plt.show()

# %% [markdown]
# <a id="map"></a>
# ## 5. Rays per cell of a radio map
#
# `field.radio_map` asks for the total, the strongest path, the delay spread and the best beam at every cell of a floor
# plan, without the spectra. Line of sight and mirrors are exact; scattering takes as many rays as the grid says. The
# error is that against the finest grid, over the cells without line of sight, where it matters.

# %%
model = with_effects(mirrors=2, scatterings=2, mirror_scatter=True, scatter_mirror=False)
shapes = ((5, 10), (10, 20), (20, 40), (40, 80))
model.radio_map(1.5, 3.0)
maps, rows = [], []
for shape in shapes:
    start = time.perf_counter()
    maps.append(model.radio_map(1.5, 1.0, shape=shape))
    rows.append(
        {"value": 4 * shape[0] * shape[1], "seconds": (time.perf_counter() - start) / maps[-1].free.sum()}
    )
places = maps[-1].positions.reshape(-1, 3)
hidden = ~scene.mesh.visible(np.broadcast_to(model.transmitter, places.shape).copy(), places)
hidden = hidden.reshape(maps[-1].free.shape) & maps[-1].free
for quantity, label in (("total_path_gain", "total path gain"), ("best_beam_gain", "best beam, 2 degrees")):
    for row, found in zip(rows, maps, strict=True):
        change = 10 * np.log10(getattr(found, quantity)[hidden] / getattr(maps[-1], quantity)[hidden])
        row[label] = np.sqrt(np.mean(change**2))
figure, ax = plt.subplots(figsize=(6, 3.4))
curve(ax, rows[:-1], "total path gain", "total path gain")
curve(ax, rows[:-1], "best beam, 2 degrees", "best beam, 2 degrees", "#b3123c")
ax.set_xlabel("time a cell [ms]"), ax.set_ylabel("rms error, blocked cells [dB]"), ax.legend()
plt.show()

# %%
found = model.radio_map(1.5, 0.6)
figure, axes = plt.subplots(1, 2, figsize=(14, 4.8))
found.plot("total_path_gain", ax=axes[0])
found.plot("best_beam_snr_db", ax=axes[1])
plt.show()
print(f"{found.free.sum()} cells")

# %% [markdown]
# <a id="follows"></a>
# ## 6. What follows
#
# - Cutoffs: as low as the depth of the image asks, no lower; they cost little.
# - Rays per pixel: 9 are enough for a field whose materials are known to a decibel; the ground truth takes 64.
# - Grid: choose it for the directions that you want to tell apart, not for the power.
# - Bounces: where there is line of sight, stop at scattering. Behind corners every step counts.
# - Maps: a few thousand rays a cell do what a spectrum needs a hundred thousand for, unless its beams are narrow.

# %%
print(f"all of it: {time.perf_counter() - clock:.0f} s")
