"""Paths made up for tests of channels."""

import numpy as np

from warprrf.rf.paths.path_set import Paths
from warprrf.rf.spectra.spectrum import angles_from_directions

CARRIER = 287.28e9


def random_directions(count, seed=0):
    """Unit vectors of a seed or a generator."""
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def paths_along(arrival, departure, gain, *, tau=1e-8, kind="mirror", **more):
    """Paths of one receiver along given directions, to where they come from and to where they set out."""
    theta_r, phi_r = angles_from_directions(arrival)
    theta_t, phi_t = angles_from_directions(departure)
    count = len(gain)
    return Paths(
        gain=np.asarray(gain, complex), tau=np.broadcast_to(tau, count).copy(), theta_r=theta_r, phi_r=phi_r,
        theta_t=theta_t, phi_t=phi_t, vertices=np.full((count, 1, 3), np.nan), kind=np.full(count, kind, dtype="<U7"),
        valid=np.ones(count, dtype=bool), frequency_hz=CARRIER, **more,
    )  # fmt: skip


def random_paths(count, seed=0, kind="mirror", latest=60e-9, jones=False):
    rng = np.random.default_rng(seed)
    arrival, departure = random_directions(count, rng), random_directions(count, rng)
    gain = rng.normal(size=count) + 1j * rng.normal(size=count)
    tau = rng.uniform(5e-9, latest, count)
    shape = (count, 2, 2)
    return paths_along(
        arrival, departure, gain, tau=tau, kind=kind,
        jones=rng.normal(size=shape) + 1j * rng.normal(size=shape) if jones else None,
        transmitter=np.zeros(3), receiver=np.array([5.0, 1.0, -1.0]),
    )  # fmt: skip
