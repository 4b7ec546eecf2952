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
# # From a radio field to beams
#
# A large array has to point before it can speak. Searching for the direction costs pilots: one for every beam, at every
# receiver, again whenever it moves. A radio field answers from geometry instead. This notebook goes from ten spectra of
# the lobby to beams, received SNR and spectral efficiency, without a single pilot, and looks at what a field cannot know.
#
# 1. [The field](#field)
# 2. [Codebooks](#codebooks): what a beam is
# 3. [Choosing](#choosing) from power alone, and why
# 4. [The true channel](#truth)
# 5. [Many receivers](#receivers), beside exhaustive search and pointing at the transmitter
# 6. [How large an array?](#size)
# 7. [Several users](#users) at once
#
# It runs on a CPU in half a minute, on few receivers; `python -m benchmarks beams` makes the figures that count. Metres, hertz,
# radians; path gain is linear unless it says dB.

# %%
import time
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib_inline.backend_inline import set_matplotlib_formats

import warprrf as wr

DATA = next(p / "data/lobby" for p in [Path.cwd(), *Path.cwd().parents] if (p / "data/lobby").is_dir())
RECEIVERS = 24
set_matplotlib_formats("jpeg", pil_kwargs={"quality": 85})
plt.rcParams.update(
    {"figure.dpi": 70, "figure.constrained_layout.use": True, "image.interpolation": "nearest"}
)
clock = time.perf_counter()

# %% [markdown]
# <a id="field"></a>
# ## 1. The field
#
# Ten spectra and the room's geometry. To be quick, the geometry is the scene's own mesh (notebook 01 reconstructs one
# from photos, and the benchmark uses that), and the field holds line of sight, one mirror reflection and one scattering
# bounce. Everything below works the same for any fitted field.

# %%
dataset = wr.SpectrumDataset.load(DATA / "spectra.nc")
scene = wr.Scene.load(DATA / "scene.xml")
train, test = dataset.split(10)
start = time.perf_counter()
single = wr.Effects(mirrors=1, scatterings=1, mirror_scatter=False, scatter_mirror=False, residual=False)
field = wr.RadioField.fit(scene, train, effects=single)
print(f"fitted to {len(train)} receivers in {time.perf_counter() - start:.1f} s")

# %% [markdown]
# <a id="codebooks"></a>
# ## 2. Codebooks
#
# A beam is a vector of weights $w$ over the elements; between a beam at each end the received amplitude is
# $w_r^T H w_t$. Weights have unit norm: a beam has no more power than one element, it only sends it elsewhere. Along its
# own direction $N$ elements gain $N$. The DFT codebook of $N$ beams is orthonormal, so its beams share all directions
# between them; neighbours cross 3.9 dB below their peaks. Oversampled twice they cross 0.9 dB down: a wrong neighbour
# then costs little, which is what matters when nobody checks.
#
# Elements are isotropic here, so an upright array cannot tell front from back: a beam has a twin behind it.

# %%
array = wr.PlanarArray(16, 16, orientation=wr.channel.orientation_towards([1.0, 0.0, 0.0]))
azimuth = np.radians(np.linspace(-90, 90, 721))
around = np.stack([np.cos(azimuth), np.sin(azimuth), np.full_like(azimuth, 0.03)], axis=-1)
around /= np.linalg.norm(around, axis=-1, keepdims=True)
figure, axes = plt.subplots(1, 2, figsize=(13, 3.3), sharey=True)
for ax, oversampling in zip(axes, (1, 2), strict=True):
    pattern = 10 * np.log10(
        np.abs(wr.channel.dft_codebook(array, oversampling).amplitude(around)) ** 2 + 1e-9
    )
    level = pattern[pattern.max(axis=1) > 20]
    ax.plot(np.degrees(azimuth), level.T, linewidth=0.8)
    ax.plot(np.degrees(azimuth), pattern.max(axis=0), color="black", linewidth=2)
    ax.set_ylim(0, 26), ax.set_xlabel("azimuth [degrees]"), ax.grid(alpha=0.3)
    ax.set_title(
        f"oversampled {oversampling}: best beam (black) at least {pattern.max(axis=0)[60:-60].min():.1f} dB"
    )
axes[0].set_ylabel("gain [dB]")
plt.show()

# %% [markdown]
# <a id="choosing"></a>
# ## 3. Choosing from power alone
#
# `select_beams` takes the paths of a receiver and returns the pairs of beams with the largest *mean* gain, the sum over
# paths of power times the beams' gains. Why not $|w_r^T H w_t|^2$ of the predicted channel? Because its phases are
# nobody's to know: at 300 GHz a path's phase turns once a millimetre, while a wall reconstructed from photos stands
# right to a centimetre, and scattering is the sum of a rough surface's many parts. What the field does know is where
# power comes from.

# %%
blocked = int(np.flatnonzero(~test.line_of_sight)[0])
receiver = test.receivers[blocked]
# All arrays are upright and face each other across the room: a beam's index means the same direction everywhere.
level = (dataset.transmitter - dataset.receivers.mean(axis=0)) * [1, 1, 0]


def book(side, toward):
    """Codebook of a square array, oversampled twice; one beam for a single element."""
    array = wr.PlanarArray(side, side, orientation=wr.channel.orientation_towards(toward))
    return wr.channel.dft_codebook(array, 2 if side > 1 else 1)


arrays = {f"rx {n * n}": (book(1, -level), book(n, level)) for n in (4, 8, 16, 32)}
arrays |= {f"tx {n * n}": (book(n, -level), book(1, level)) for n in (4, 8, 16, 32)}
arrays["tx 64, rx 64"] = book(8, -level), book(8, level)
rx_book = arrays["rx 256"][1]
paths = field.paths(receiver)
choice = wr.channel.select_beams(paths, rx_array=rx_book, count=3)
print(
    f"blocked receiver: {len(paths.gain)} paths; best beams {choice.rx} with {10 * np.log10(choice.gain).round(1)} dB"
)

predicted, truth = field.spectrum(receiver), test[blocked]
figure, axes = plt.subplots(1, 3, figsize=(16, 3.2))
truth.plot(ax=axes[0]), axes[0].set_title("true spectrum")
predicted.plot(ax=axes[1]), axes[1].set_title("predicted spectrum")
zenith, turn = np.meshgrid(
    (np.arange(60) + 0.5) * np.pi / 60, -np.pi + (np.arange(120) + 0.5) * np.pi / 60, indexing="ij"
)
sphere = np.stack([np.sin(zenith) * np.cos(turn), np.sin(zenith) * np.sin(turn), np.cos(zenith)], axis=-1)
one = wr.channel.Codebook(rx_book.array, (rx_book.beam(choice.rx[0])[None],))
shown = 10 * np.log10(np.abs(one.amplitude(sphere.reshape(-1, 3))[0]) ** 2 + 1e-3).reshape(60, 120)
image = axes[2].imshow(shown, extent=(-180, 180, 180, 0), aspect="auto", vmin=0, vmax=24)
figure.colorbar(image, ax=axes[2], label="gain [dB]")
axes[2].set_title("the chosen beam, and its twin behind"), axes[2].set_xlabel("azimuth [degrees]")
plt.show()

# %% [markdown]
# <a id="truth"></a>
# ## 4. The true channel
#
# What is the choice worth? The true channel is made from what the data set holds of this receiver: line of sight and
# mirrors of the true scene by the image method with every element at its own distance, and in every other pixel above
# the floor one wave with that pixel's power, delay and angle of departure and a random phase, over a band of 2.16 GHz.
# There exhaustive search tries all 1024 beams and keeps the one that received most.

# %%
FREQUENCIES = dataset.frequency_hz + ((np.arange(8) + 0.5) / 8 - 0.5) * 2.16e9


def true_paths(index):
    """Specular paths of a test receiver, and its scattering as waves with random phases."""
    point, spectrum = test.receivers[index], test[index]
    specular = wr.trace_paths(
        scene, transmitter=test.transmitter, receivers=point, frequency_hz=test.frequency_hz, mirror_order=1
    )
    rows, columns = spectrum.shape
    theta, phi = np.meshgrid(
        (np.arange(rows) + 0.5) * np.pi / rows,
        -np.pi + (np.arange(columns) + 0.5) * 2 * np.pi / columns,
        indexing="ij",
    )
    arrival = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    away = (arrival @ specular.arrival.T).max(axis=-1, initial=-1) < np.cos(5 * test.beam_sigma_rad)
    above = away & (spectrum.path_gain > test.floor) & np.isfinite(spectrum.delay_s)
    power, tau = spectrum.path_gain[above], spectrum.delay_s[above]
    turns = np.exp(2j * np.pi * np.random.default_rng(index).random(above.sum()))
    scattered = replace(
        specular, gain=np.sqrt(power) * turns, tau=tau, theta_r=theta[above], phi_r=phi[above],
        theta_t=spectrum.aod[above][:, 0], phi_t=spectrum.aod[above][:, 1],
        vertices=np.full((above.sum(), *specular.vertices.shape[1:]), np.nan),
        kind=np.full(above.sum(), "diffuse"), valid=np.ones(above.sum(), bool), jones=None, interactions=np.zeros(0, np.int8),
    )  # fmt: skip
    return specular, scattered


def gains(index, tx, rx):
    """|w_r^T H w_t|^2 of every pair of beams at every frequency, shape (F, Br, Bt)."""
    known, waves = true_cache.setdefault(index, true_paths(index)), []
    for found, wave in zip(known, ("spherical", "plane"), strict=True):
        waves.append(
            found.cfr(
                FREQUENCIES, tx_array=tx.array, rx_array=rx.array, wave=wave, squint=False, diffuse="given"
            )
        )
    h = np.moveaxis(sum(waves), -1, 0)
    received = rx.received(np.swapaxes(h, 1, 2))
    return np.abs(tx.received(np.swapaxes(received, 1, 2))) ** 2


true_cache = {}
worth = gains(blocked, *arrays["rx 256"])[:, :, 0]
mean = 10 * np.log10(worth.mean(axis=0))
expected = 10 * np.log10(wr.channel.beam_gains(paths, rx_array=rx_book)[:, 0])
print(
    f"exhaustive search {mean.max():.1f} dB, our beam {mean[choice.rx[0]]:.1f} dB, the median beam {np.median(mean):.1f} dB"
)
figure, ax = plt.subplots(figsize=(5.5, 4.2))
ax.scatter(expected, mean, s=5, color="#0b6e99")
ax.scatter(expected[choice.rx[0]], mean[choice.rx[0]], s=70, facecolors="none", edgecolors="#a8200d")
low, high = mean.max() - 40, mean.max() + 3
ax.plot([low, high], [low, high], color="#888888", linewidth=0.8)
ax.set_xlim(low, high), ax.set_ylim(low, high), ax.grid(alpha=0.3)
ax.set_xlabel("predicted gain [dB]"), ax.set_ylabel("gain on the true channel [dB]")
ax.set_title("all 1024 beams (red: chosen)")
plt.show()

# %% [markdown]
# The best beams lie near the diagonal. Weak beams scatter about it: they hold scattering alone, whose phases add up
# or cancel, and side lobes of what is strong. That is no matter, since nobody would choose them.
#
# <a id="receivers"></a>
# ## 5. Many receivers
#
# Half of them see the transmitter, half do not. Transmitted 20 dBm, 10 dB noise figure. Exhaustive search here costs nothing; with a pilot of 10 us for each of 1024
# beams it would spend half of the 20 ms for which a walking user's beam holds.

# %%
ratio = 10 ** ((20.0 - (-173.98 + 10 * np.log10(2.16e9) + 10.0)) / 10)
half = RECEIVERS // 2
chosen = np.sort([*np.flatnonzero(test.line_of_sight)[:half], *np.flatnonzero(~test.line_of_sight)[:half]])
sees = test.line_of_sight[chosen]


def straight(point):
    """The paths of somebody who knows where the transmitter is, and nothing else."""
    nothing = np.full((1, 1, 3), np.nan)
    return wr.Paths.from_points(
        test.transmitter, point, nothing, np.ones(1, complex), np.array(["los"]), test.frequency_hz
    )


asked = {
    "our field": [field.paths(test.receivers[k]) for k in chosen],
    "at the transmitter": [straight(test.receivers[k]) for k in chosen],
}
results = {}
for name, (tx, rx) in arrays.items():
    for k, index in enumerate(chosen):
        worth = gains(index, tx, rx)
        results.setdefault((name, "exhaustive"), []).append(worth.mean(axis=0).max())
        for method, found in asked.items():
            pick = wr.channel.select_beams(found[k], tx, rx)
            results.setdefault((name, method), []).append(worth[:, pick.rx[0], pick.tx[0]].mean())
results = {key: np.array(value) for key, value in results.items()}

print(f"{'':<16}{'':<22}{'within 1 dB: sees':>18}{'blocked':>9}{'bit/s/Hz: sees':>16}{'blocked':>9}")
for (name, method), gain in results.items():
    near = 10 * np.log10(results[name, "exhaustive"] / gain) <= 1
    rate = np.log2(1 + ratio * gain)
    print(
        f"{name:<16}{method:<22}{near[sees].mean():>18.0%}{near[~sees].mean():>9.0%}"
        f"{rate[sees].mean():>16.2f}{rate[~sees].mean():>9.2f}"
    )

# %% [markdown]
# <a id="size"></a>
# ## 6. How large an array?
#
# Every doubling of a side gains 6 dB where the beam is right. Where it points at a wall that hides the transmitter, a
# larger array only points there more sharply: the curve of pointing at the transmitter falls for blocked receivers.

# %%
figure, axes = plt.subplots(1, 2, figsize=(12, 3.8), sharey=True)
sizes = [16, 64, 256, 1024]
colours = {"exhaustive": "#222222", "our field": "#0b6e99", "at the transmitter": "#6a3d9a"}
for ax, where, title in ((axes[0], sees, "line of sight"), (axes[1], ~sees, "blocked")):
    for method, colour in colours.items():
        snr = [10 * np.log10(np.median(ratio * results[f"rx {n}", method][where])) for n in sizes]
        ax.plot(sizes, snr, "o--" if method == "exhaustive" else "o-", color=colour, label=method)
    ax.set_xscale("log", base=4), ax.set_xticks(sizes, [str(n) for n in sizes]), ax.grid(alpha=0.3)
    ax.set_xlabel("elements at the receiver"), ax.set_title(f"{title}: {where.sum()} receivers")
axes[0].set_ylabel("median received SNR [dB]"), axes[0].legend()
plt.show()

# %% [markdown]
# <a id="users"></a>
# ## 7. Several users at once
#
# With 256 elements at the transmitter four users can be served in the same band, if their beams don't meet. Each one's
# best beam may be another's worst interference; the field knows every user's gain in every beam, so it can weigh that.
# `select_beams_multiuser` lets users choose in turn until nobody's change raises the predicted sum of rates.

# %%
tx, rx = arrays["tx 256"]
sums = {"each for itself": [], "minding the others": []}
for first in range(0, RECEIVERS - 3, 4):
    group = range(first, first + 4)
    seen = [asked["our field"][k] for k in group]
    true = [gains(chosen[k], tx, rx).mean(axis=0)[0] for k in group]
    alone = [wr.channel.select_beams(p, tx) for p in seen]
    together = wr.channel.select_beams_multiuser(seen, tx, noise=1 / ratio)
    for how, beams in (("each for itself", [c.tx[0] for c in alone]), ("minding the others", together.tx)):
        heard = np.array([gain[beams] for gain in true])  # of each user in each one's beam
        wanted = np.diag(heard)
        # the transmitter's power is shared by its four beams
        sinr = wanted / (heard.sum(axis=1) - wanted + 4 / ratio)
        sums[how].append(np.log2(1 + sinr).sum())
for how, values in sums.items():
    print(f"{how:<20}{np.mean(values):6.2f} bit/s/Hz over four users, on the true channel")
print(f"all of it: {time.perf_counter() - clock:.0f} s")
