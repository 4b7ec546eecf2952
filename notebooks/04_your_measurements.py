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
# # Your measurements: a horn's table, a field, and where to measure next
#
# A mesh of a room without any material, and a CSV file of received powers as a channel sounder writes them. That is all that
# goes in.
#
# 1. [The room and the table](#table)
# 2. [A field from no measurement, and from a few](#fit): the sounder's gain, readings that cannot be explained
# 3. [How wrong it is](#error)
# 4. [Where to measure next](#next), and what that gains
#
# The readings are made from spectra of Sionna RT at three bounces: the truth here is never a field of this library. The horn is
# 10 degrees wide, looks to 36 azimuths at three elevations, its chain has a gain that nobody knows, 1 dB of noise, and one
# reading in fifty is wrong by 20 dB.

# %%
import tempfile
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib_inline.backend_inline import set_matplotlib_formats

import warprrf as wr

DATA = next(p / "data/lobby" for p in [Path.cwd(), *Path.cwd().parents] if (p / "data/lobby").is_dir())
set_matplotlib_formats("png")
plt.rcParams.update({"figure.dpi": 70, "figure.constrained_layout.use": True})
clock = time.perf_counter()
folder = Path(tempfile.mkdtemp())

# %% [markdown]
# <a id="table"></a>
# ## 1 The room and the table
#
# `Mesh.load` reads GLB, OBJ, STL and PLY; here the mesh of the lobby is taken without its materials.

# %%
truth = wr.SpectrumDataset.load(DATA / "spectra_sionna.nc")
places, test = truth.split(40)
test = test.subset(np.arange(0, 100, 4))
bare = wr.Scene.load(DATA / "scene.xml").mesh
room = wr.Mesh(bare.vertices, bare.faces)

HORN = wr.horn(np.radians(10))
# The spectra have a beam of their own: a horn that is so much narrower sees in them what HORN sees in the room.
BEAM_DEG = np.degrees(truth.beam_sigma_rad) * np.sqrt(8 * np.log(2))
REST = wr.horn(np.radians(np.sqrt(10**2 - BEAM_DEG**2)))
AZIMUTH, ELEVATION = (angle.ravel() for angle in np.meshgrid(np.arange(-180, 180, 10.0), [-30.0, 0.0, 30.0]))
GAIN_DB = -23.7  # of the sounder's chain: to be found


def unit(azimuth_deg, elevation_deg):
    """Unit vectors, x to y and up."""
    a, e = np.broadcast_arrays(np.radians(azimuth_deg), np.radians(elevation_deg))
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)


def measure(chosen, seed=0):
    """The table that the sounder writes at the places `chosen`."""
    rng, (rows, columns) = np.random.default_rng(seed), truth.shape
    up = 90 - (np.arange(rows) + 0.5) * 180 / rows
    around = -180 + (np.arange(columns) + 0.5) * 360 / columns
    pixels = unit(around[None, :], up[:, None]).reshape(-1, 3)
    weight = REST.gain_off_boresight(np.arccos(np.clip(unit(AZIMUTH, ELEVATION) @ pixels.T, -1, 1)))
    tables = []
    for k in chosen:
        power = 10 * np.log10(weight @ places.path_gain[k].ravel().astype(float))
        power = (
            power
            + rng.normal(0, 1, len(power))
            + 20 * (rng.random(len(power)) < 0.02) * rng.choice([-1, 1], len(power))
        )
        ends = dict(
            zip(
                ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z"),
                [*truth.transmitter, *places.receivers[k]],
                strict=True,
            )
        )
        read = {"azimuth_deg": AZIMUTH, "elevation_deg": ELEVATION, "power_db": np.round(power + GAIN_DB, 1)}
        tables.append(pd.DataFrame({**ends, **read, "chain": "horn"}))
    return pd.concat(tables)


def readings(chosen):
    """That table as a file, and read from it."""
    measure(chosen).to_csv(folder / "horn.csv", index=False)
    return wr.Readings.load(
        folder / "horn.csv",
        frequency_hz=300e9,
        floor=1e-15,
        receive_pattern=HORN,
        std_db=1.0,
        name="horn.csv",
    )


first = readings([7])
print(*(folder / "horn.csv").read_text().splitlines()[:4], sep="\n")
first

# %% [markdown]
# <a id="fit"></a>
# ## 2 A field from no measurement, and from a few
#
# An empty data set says where the transmitter is and at which frequency. Surfaces are then taken for what ITU-R P.2040 says of
# building materials. The same call with readings fits materials, and the gain of the chain beside them. `quick=True` takes
# one ray a pixel: leave it out for two decibels more.

# %%
nothing = wr.SpectrumDataset.empty(
    transmitter=truth.transmitter, frequency_hz=300e9, shape=truth.shape, floor=truth.floor
)
fields = {"no measurement": wr.RadioField.fit(room, nothing)}
fields["1 place"] = wr.RadioField.fit(room, [nothing, first], quick=True)
report = fields["1 place"].report
print(f"gain of the chain: {report['chains']['horn']['gain_db']:.2f} dB, true {GAIN_DB} dB")

# %% [markdown]
# Readings that the field misses by five standard deviations are taken to be wrong: the fit leaves them out and names their rows.

# %%
named = report["unexplained"].get("horn.csv", [])
print(f"{len(named)} of {len(first)} readings cannot be explained")
fig, ax = plt.subplots(figsize=(9, 3.2))
power_db = 10 * np.log10(first.power)
for start, elevation in enumerate((-30, 0, 30)):
    ax.plot(AZIMUTH[:36], power_db[36 * start : 36 * start + 36], "o-", ms=3, label=f"elevation {elevation}")
ax.plot(AZIMUTH[named], power_db[named], "x", color="#c0392b", ms=11, mew=2, label="not explained")
ax.set(xlabel="azimuth [degrees]", ylabel="power [dB]"), ax.grid(alpha=0.3)
ax.legend(loc="upper left", fontsize=8)
plt.show()

# %% [markdown]
# <a id="error"></a>
# ## 3 How wrong it is
#
# At 25 places where nothing was measured. Beside the figures, the spectrum at one that does not see the transmitter.


# %%
def figures(field):
    found = wr.evaluate(test, field.spectrum)
    return found["psnr_db"], found["direction_within_3deg_blocked"], found["beam_gain_loss_db"]


scores = {name: figures(field) for name, field in fields.items()}
for name, (psnr, blocked, loss) in scores.items():
    print(
        f"{name:16s} PSNR {psnr:5.2f} dB, blocked: within 3 degrees {blocked:4.0%}, beam loss {loss:.2f} dB"
    )

hidden = int(np.flatnonzero(~test.line_of_sight)[0])
fig, axes = plt.subplots(1, 3, figsize=(13, 2.6))
test[hidden].plot(ax=axes[0])
axes[0].set_title("truth")
for ax, (name, field) in zip(axes[1:], fields.items(), strict=True):
    field.spectrum(test.receivers[hidden]).plot(ax=ax)
    ax.set_title(name)
for ax in axes:
    ax.images[0].set_clim(*truth.range_db)

# %% [markdown]
# <a id="next"></a>
# ## 4 Where to measure next
#
# Forty places could be measured. `suggest` takes those whose readings lower the expected error most at all of them, given what
# was measured so far: here nothing. Beside its three: three drawn at random, five times. Five draws and 25 receivers show the size
# of the gain, not its decimals; whole spectra over ten draws are in the documentation's *Fields from measurements*.

# %%
start = time.perf_counter()
chosen = fields["no measurement"].suggest(places.receivers, 3)
print(f"measure first at {chosen.tolist()}, chosen in {time.perf_counter() - start:.1f} s")


def fitted(chosen):
    return wr.RadioField.fit(room, [nothing, readings(chosen)], quick=True)


scores["3 suggested"] = figures(fitted(chosen))
rng = np.random.default_rng(1)
random = [figures(fitted(rng.choice(40, 3, replace=False)))[0] for _ in range(5)]
print(
    f"PSNR with three suggested {scores['3 suggested'][0]:.2f} dB, "
    f"with three at random {np.mean(random):.2f} dB, {min(random):.2f} to {max(random):.2f} dB"
)

# %% [markdown]
# A field goes on from what it was fitted to: the places that it names next are others.

# %%
print(f"after place 7: {fields['1 place'].suggest(places.receivers, 2).tolist()}")

fig, (plan, bars) = plt.subplots(1, 2, figsize=(12, 4), width_ratios=(3, 2))
edges = room.vertices[room.faces][np.abs(room.face_normals[:, 2]) < 0.5]
for triangle in edges:
    plan.plot(*triangle[[0, 1, 2, 0], :2].T, color="0.75", lw=0.6)
plan.plot(*places.receivers[:, :2].T, "o", color="0.5", ms=4, label="could be measured")
for rank, k in enumerate(chosen):
    plan.annotate(
        str(rank + 1),
        places.receivers[k, :2],
        (6, 4),
        textcoords="offset points",
        color="#c0392b",
        weight="bold",
    )
plan.plot(*places.receivers[chosen, :2].T, "o", color="#c0392b", label="suggested")
plan.plot(*truth.transmitter[:2], "k^", ms=9, label="transmitter")
(
    plan.set(aspect="equal", xlabel="x [m]", ylabel="y [m]"),
    plan.legend(loc="center left", bbox_to_anchor=(1.0, 0.5)),
)
bars.scatter(range(3), [s[0] for s in scores.values()], color=["0.6", "#0b6e99", "#c0392b"], s=60)
bars.scatter(np.full(len(random), 3), random, color="0.3")
bars.set_xticks(range(4), ["nothing", "1 place", "3 suggested", "3 random"])
bars.set(ylabel="PSNR [dB]", xlim=(-0.5, 3.5)), bars.grid(alpha=0.3, axis="y")
plt.show()
# %%
print(f"all of it: {time.perf_counter() - clock:.0f} s")
