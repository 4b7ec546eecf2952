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
# # From photos of a lobby to a radio field
#
# A radio radiance field answers, for any receiver in a room: which paths arrive, from where, how they left the transmitter, how
# strong, how late. This notebook builds one from two things: **photos** of the room and **a few radio spectra**
# measured in it. It runs on a CPU, on the photos of one part of the room and with few optimisation steps, so its
# figures are worse than those of `make lobby`; every step is the same.
#
# 1. [The photos](#photos) and what they must show
# 2. [Structure from motion](#sfm): cameras and sparse points, up to scale
# 3. [Metres](#metres): a handful of surveyed camera positions
# 4. [Geometry](#geometry): Gaussians, depth, a mesh
# 5. [What the transmitter sees](#los)
# 6. [A spectrum](#spectrum) and its units
# 7. [Fitting the field](#fit)
# 8. [Against the truth](#truth), beside look-ups that know no geometry
# 9. [Paths](#paths) for a link simulation
#
# Conventions: metres, seconds, hertz, radians; z up; zenith in [0, pi], azimuth in (-pi, pi]; angles of arrival point
# from the receiver to where the path last met something.

# %%
import json
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib_inline.backend_inline import set_matplotlib_formats
from PIL import Image

import warprrf as wr
from warprrf.geometry.photos.config import ReconstructionConfig

DATA = next(p / "data/lobby" for p in [Path.cwd(), *Path.cwd().parents] if (p / "data/lobby").is_dir())
WORK = DATA.parent.parent / "runs" / "notebook"
set_matplotlib_formats("jpeg", pil_kwargs={"quality": 85})  # photos as PNG would make this file large
plt.rcParams.update(
    {"figure.dpi": 70, "figure.constrained_layout.use": True, "image.interpolation": "nearest"}
)
clock = time.perf_counter()

# %% [markdown]
# <a id="photos"></a>
# ## 1. The photos
#
# They were rendered by a path tracer, and from here on they are ordinary JPEG files: nothing below knows the poses or
# the scene. What matters is *overlap*. A surface point is found only where several photos see it from different
# places, so the cameras walk loops through the room and look across it. A bare white wall gives the feature detector
# nothing to hold on to; signs, carpets and furniture do.

# %%
# Part of the photos: those of the north-eastern part of the room, where the transmitter hangs.
CHOSEN = [
    *range(16, 30), *range(48, 62), 69, 70, 72, 75, 78, 79, 82, 83, 84, 86, 89, 92, 93, 94, 96, 97, 99, 100, 105, 108,
    110, 113, 114, 117, 119,
]  # fmt: skip
roles = json.loads((DATA / "photos.json").read_text())
names = [roles["photos"][index] for index in CHOSEN]
photos = [DATA / "photos" / name for name in names]
held_out = [name for name in roles["held_out"] if name in names]
surveyed = {n: p for n, p in json.loads((DATA / "surveyed.json").read_text()).items() if n in names}
print(
    f"{len(photos)} photos, {len(held_out)} of them held out for scoring, {len(surveyed)} with surveyed positions"
)

figure, axes = plt.subplots(2, 4, figsize=(13, 5))
for ax, path in zip(axes.flat, photos[:: max(1, len(photos) // 8)], strict=False):
    ax.imshow(Image.open(path).resize((320, 240)))
    ax.set_title(path.name, fontsize=9)
    ax.axis("off")
plt.show()

# %% [markdown]
# <a id="sfm"></a>
# ## 2. Structure from motion
#
# COLMAP (through pycolmap) finds SIFT features in every photo, matches them between photos, and solves for the camera
# poses and 3D points that explain the matches. *Why trust it?* Each point is seen by several cameras, and its
# **reprojection error** says by how many pixels the rays miss each other. Long tracks (many photos for one point) with
# errors well below a pixel mean a stiff model.

# %%
from warprrf.geometry.photos.posed.sfm import structure_from_motion
from warprrf.geometry.photos.posed.sparse import align_to_known

start = time.perf_counter()
sparse = structure_from_motion(
    photos, workspace=WORK / "workspace", config=ReconstructionConfig(max_features=1200), seed=0
)
print(
    f"{len(sparse.cameras)} of {len(photos)} photos posed, {len(sparse.points)} points, "
    f"{time.perf_counter() - start:.0f} s"
)

figure, axes = plt.subplots(1, 2, figsize=(11, 3))
axes[0].hist(sparse.track_length, bins=np.arange(1.5, 20), color="#0b6e99")
axes[0].set_xlabel("photos that see a point")
axes[1].hist(sparse.reprojection_error, bins=40, range=(0, 2), color="#0b6e99")
axes[1].set_xlabel("reprojection error [pixels]")
axes[0].set_ylabel("points")
plt.show()

# %% [markdown]
# <a id="metres"></a>
# ## 3. Metres
#
# Photos know no scale: a doll's house and a hall look alike. Radio does, since path gain and delay depend on metres.
# So a few camera positions are surveyed with a tape, and the similarity transform (scale, rotation, shift) that fits
# them best brings the model to metres. What is left over after the fit tells how good the model is *where nobody
# measured*: here the true poses, which take no part in anything but this check, say the same.

# %%
metric = align_to_known(sparse, surveyed)
poses = json.loads((DATA / "poses_true.json").read_text())["views"]
true_places = {n: np.linalg.inv(view["world_to_camera"])[:3, 3] for n, view in poses.items()}
error = np.array([np.linalg.norm(c.position - true_places[n]) for n, c in metric.cameras.items()])
print(
    f"rms at the surveyed positions {100 * metric.scale_rms_m:.2f} cm, at all cameras {100 * np.sqrt(np.mean(error**2)):.2f} cm"
)

figure, ax = plt.subplots(figsize=(9, 6.5))
ax.scatter(*metric.points[:, :2].T, c=np.clip(metric.colors, 0, 1), s=2, linewidths=0)
for name, camera in metric.cameras.items():
    forward = camera.world_to_camera[2, :3]
    colour = "#a8200d" if name in surveyed else "#0b6e99"
    ax.arrow(*camera.position[:2], *0.45 * forward[:2], color=colour, head_width=0.12, linewidth=0.8)
ax.set_aspect("equal")
ax.set_xlim(-0.5, 15.5), ax.set_ylim(-0.5, 12.5)
ax.set_xlabel("x [m]"), ax.set_ylabel("y [m]")
ax.set_title("sparse points and cameras from above (red: surveyed)")
plt.show()

# %% [markdown]
# <a id="geometry"></a>
# ## 4. Geometry: Gaussians, then a mesh
#
# Sparse points have holes. So small 3D Gaussians are put on them and optimised until they *render* the photos: a
# photo's pixel is the front-to-back blend of all Gaussians on its ray. Where the render is wrong, Gaussians are split
# or moved; abnormally large ones are removed, because later a Gaussian's place will stand for a point on a surface.
#
# From the Gaussians come depth maps, and from those one mesh. *Why both?* Gaussians carry appearance and later the
# directional gain; the mesh answers yes-or-no questions that Gaussians answer badly: does anything block this line,
# which way does this wall face.
#
# `reconstruct` does all steps, and takes up the structure-from-motion result above from its workspace.

# %%
start = time.perf_counter()
rec = wr.reconstruct(
    photos,
    workspace=WORK / "workspace",
    known_positions=surveyed,
    held_out=held_out,
    config=ReconstructionConfig(max_features=1200, gaussians=8000),
    iterations=100,
    seed=0,
)
print(
    f"{len(rec.gaussians)} Gaussians, {len(rec.mesh.faces)} triangles, {len(rec.patches)} planar patches, "
    f"{time.perf_counter() - start:.0f} s"
)

# %%
name = held_out[0]
truth = np.asarray(Image.open(DATA / "photos" / name), dtype=np.float32) / 255
view = wr.render(rec.gaussians, rec.cameras[name])
print(
    f"{name}, never shown to the optimiser: {-10 * np.log10(np.mean((np.clip(view.features, 0, 1) - truth) ** 2)):.1f} dB"
)
figure, axes = plt.subplots(1, 3, figsize=(14, 3.7))
axes[0].imshow(truth), axes[0].set_title("photo")
axes[1].imshow(np.clip(view.features, 0, 1)), axes[1].set_title("render")
shown = axes[2].imshow(np.where(np.isfinite(view.depth), view.depth, np.nan), cmap="viridis")
axes[2].set_title("depth of the Gaussians")
figure.colorbar(shown, ax=axes[2], label="range [m]")
for ax in axes:
    ax.axis("off")
plt.show()

# %% [markdown]
# The mesh against the true room, in a horizontal section at 1.2 m. The true scene is used here and in section 8 only.

# %%
scene = wr.Scene.load(DATA / "scene.xml")
figure, ax = plt.subplots(figsize=(9, 6.5))
for mesh, colour, label in ((scene.mesh, "#bbbbbb", "true"), (rec.mesh, "#0b6e99", "reconstructed")):
    # An edge of the section runs between the two points where a triangle's sides cross the plane.
    corners = mesh.vertices[mesh.faces]
    following = np.roll(corners, -1, axis=1)
    up = corners[..., 2] - 1.2
    down = following[..., 2] - 1.2
    crossed = up * down < 0
    met = crossed.sum(axis=1) == 2
    share = (up / np.where(crossed, up - down, 1))[..., None]
    ends = (corners + share * (following - corners))[met][crossed[met]].reshape(-1, 2, 3)
    ax.plot(*ends.transpose(2, 1, 0)[:2], color=colour, linewidth=3 if label == "true" else 1)
    ax.plot([], color=colour, label=label)
ax.set_aspect("equal"), ax.legend(), ax.set_xlabel("x [m]"), ax.set_ylabel("y [m]")
plt.show()

# %% [markdown]
# <a id="los"></a>
# ## 5. What the transmitter sees
#
# At terahertz frequencies walls and furniture block completely, and next to the line of sight everything else is
# weak. Who sees the transmitter is therefore the first question, and a ray query on the mesh answers it.

# %%
dataset = wr.SpectrumDataset.load(DATA / "spectra.nc")
x, y = np.meshgrid(np.arange(0.25, 15, 0.25), np.arange(0.25, 12, 0.25))
heads = np.stack([x, y, np.full_like(x, 1.5)], axis=-1).reshape(-1, 3)
seen = rec.mesh.visible(np.broadcast_to(dataset.transmitter, heads.shape).copy(), heads).reshape(x.shape)
figure, ax = plt.subplots(figsize=(9, 6))
ax.pcolormesh(x, y, seen, cmap="Greys_r", vmin=-1, vmax=1.2, shading="nearest")
ax.scatter(*dataset.receivers[:, :2].T, c=np.where(dataset.line_of_sight, "#0b6e99", "#c4570f"), s=14)
ax.scatter(*dataset.transmitter[:2], marker="*", s=250, color="#a8200d")
ax.set_aspect("equal"), ax.set_xlabel("x [m]"), ax.set_ylabel("y [m]")
ax.set_title("light: sees the transmitter at 1.5 m height; receivers blue, orange where the truth is blocked")
plt.show()

# %% [markdown]
# <a id="spectrum"></a>
# ## 6. A spectrum
#
# A measurement is an image of the whole sphere round a receiver. A pixel holds **path gain**: received over
# transmitted power between isotropic antennas, linear, arriving through that pixel, blurred by the receiver's beam. So
# the sum over all pixels is the total path gain. Pictures are drawn in dB over a stated floor, the same for the whole
# data set.

# %%
near = (dataset.receivers[:, :2] > (8.0, 3.0)).all(axis=1)  # the part of the room that these photos show
train, test = dataset.subset(near).split(16)
test = test.subset(range(16))
print(
    f"{dataset.frequency_hz / 1e9:g} GHz, {len(train.receivers)} receivers to learn from, {len(test.receivers)} held out"
)
blocked = int(np.flatnonzero(~test.line_of_sight)[0])
open_view = int(np.flatnonzero(test.line_of_sight)[0])
figure, axes = plt.subplots(1, 2, figsize=(14, 3.6))
for ax, index, title in ((axes[0], open_view, "line of sight"), (axes[1], blocked, "blocked")):
    truth = test[index]
    truth.plot(ax=ax)
    ax.set_title(f"{title}: {10 * np.log10(truth.total_path_gain):.1f} dB in all")
plt.show()

# %% [markdown]
# <a id="fit"></a>
# ## 7. Fitting the field
#
# Geometry stays as it is. What a receiver sees of it, the blending weights of every Gaussian in every pixel, does not
# change while the radio part is learned, so it is computed once; the fit then works on a sparse matrix, with no
# rendering inside the loop.
#
# Two models. **RF-3DGS+** learns how strongly each Gaussian radiates in each direction (spherical harmonics) and takes
# the decay with distance from the path length transmitter - surface - receiver. That is what it has over RF-3DGS, and
# delays and departure angles follow from the same geometry instead of being learned. (Its loss goes up and down because
# every step sees another batch of receivers.) The **bistatic** model, the default, obeys what scattering does: line of
# sight and mirrors by the image method, and for every surface a mix of scattering lobes that depend on where the light
# comes from and where it goes. Its few parameters belong to materials, so a handful of spectra suffices, and it tries on
# receivers held out of the training set which of three sets of effects (`wr.Effects`) predicts them best.

# %%
start = time.perf_counter()
harmonic = wr.RadioField.fit(rec, train, model="rf3dgs+", iterations=60, seed=0)
print(f"RF-3DGS+: {time.perf_counter() - start:.1f} s for {len(train.receivers)} receivers")
start = time.perf_counter()
field = wr.RadioField.fit(rec, train, model="bistatic", seed=0)
print(f"bistatic: {time.perf_counter() - start:.1f} s, {field.report['materials']} materials")
for choice in field.report["choices"]:
    print(f"  {choice['term']:<28}{choice['rmse_db']:6.2f} dB  {'kept' if choice['kept'] else 'left out'}")
losses = harmonic.report["losses"]["gain"]
figure, ax = plt.subplots(figsize=(6, 2.6))
ax.plot(losses, color="#0b6e99")
ax.set_xlabel("step"), ax.set_ylabel("0.8 L1 + 0.2 (1 - SSIM)"), ax.grid(alpha=0.3)
plt.show()

# %% [markdown]
# <a id="truth"></a>
# ## 8. Against the truth
#
# Held-out receivers, first a line-of-sight one, then a blocked one. Beside every figure stand look-ups that know no
# geometry at all: copying the nearest measurement is a strong opponent in a room full of measurements, and a method
# that loses to it has learned little.

# %%
for index in (open_view, blocked):
    truth, receiver = test[index], test.receivers[index]
    low, high = test.range_db
    guesses = {
        "bistatic": field.spectrum(receiver).path_gain_db,
        "RF-3DGS+": harmonic.spectrum(receiver).path_gain_db,
    }
    figure, axes = plt.subplots(1, 3, figsize=(16, 3.2), sharey=True)
    for ax, (name, image) in zip(axes, {"truth": truth.path_gain_db, **guesses}.items(), strict=True):
        ax.imshow(image, vmin=low, vmax=high, extent=(-180, 180, 180, 0), aspect="auto")
        ax.set_title(name), ax.set_xlabel("azimuth [degrees]")
    axes[0].set_ylabel("zenith [degrees]")
    plt.show()

# %%
methods = {"bistatic": field.spectrum, "rf3dgs+": harmonic.spectrum} | {
    name: getattr(wr.lookups, name)(train) for name in ("nearest", "idw", "constant", "mean")
}
print(f"{'method':<10}{'PSNR dB':>9}{'direction deg':>15}{'within 3 deg':>14}{'beam loss dB':>14}")
for name, predict in methods.items():
    figures = wr.evaluate(test, predict)
    print(
        f"{name:<10}{figures['psnr_db']:>9.2f}{figures['direction_median_deg']:>15.1f}"
        f"{figures['direction_within_3deg']:>14.0%}{figures['beam_gain_loss_db']:>14.1f}"
    )

# %% [markdown]
# Few photos, few steps, few receivers: look at `make lobby` for figures that count. The structure of the errors is
# already visible, though. Spherical harmonics are smooth, so they cannot draw a line of sight or a mirror reflection as
# sharp as it is; that is the limit of this family of models, not of the geometry. What is left of the bistatic model's
# error is mostly the mesh's: shadows and edges that this quick reconstruction puts in the wrong place.
#
# <a id="paths"></a>
# ## 9. Paths
#
# For a link simulation the field gives paths rather than pictures: complex gain, delay, angles of arrival and
# departure. The squared gains sum to the spectrum's sum.

# %%
receiver = test.receivers[open_view]
paths, spectrum = field.paths(receiver), field.spectrum(receiver)
power = np.abs(paths.gain[paths.valid]) ** 2
print(
    f"{paths.valid.sum()} paths, total {10 * np.log10(power.sum()):.2f} dB "
    f"(spectrum: {10 * np.log10(spectrum.total_path_gain):.2f} dB)"
)
order = np.argsort(power)[::-1]
kinds = np.asarray(paths.kind)[paths.valid]
figure, ax = plt.subplots(figsize=(9, 3))
ax.scatter(paths.tau[paths.valid] * 1e9, 10 * np.log10(power), s=4, color="#0b6e99")
ax.set_xlabel("delay [ns]"), ax.set_ylabel("path gain [dB]"), ax.grid(alpha=0.3)
for i in order[:3]:
    print(f"{10 * np.log10(power[i]):8.2f} dB after {paths.tau[paths.valid][i] * 1e9:7.3f} ns, {kinds[i]}")
print(f"all of it: {time.perf_counter() - clock:.0f} s")
plt.show()
