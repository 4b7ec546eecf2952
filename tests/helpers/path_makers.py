"""Paths made up for tests of channels."""

import numpy as np

from warprrf.rf.paths.path_set import Paths
from warprrf.rf.spectra.spectrum import angles_from_directions

CARRIER = 287.28e9


def random_directions(count, rng):
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def random_paths(count, seed=0, kind="mirror", latest=60e-9, jones=False):
    rng = np.random.default_rng(seed)
    theta_r, phi_r = angles_from_directions(random_directions(count, rng))
    theta_t, phi_t = angles_from_directions(random_directions(count, rng))
    shape = (count, 2, 2)
    return Paths(
        gain=rng.normal(size=count) + 1j * rng.normal(size=count),
        tau=rng.uniform(5e-9, latest, count),
        theta_r=theta_r,
        phi_r=phi_r,
        theta_t=theta_t,
        phi_t=phi_t,
        vertices=np.full((count, 1, 3), np.nan),
        kind=np.full(count, kind, dtype="<U7"),
        valid=np.ones(count, dtype=bool),
        jones=rng.normal(size=shape) + 1j * rng.normal(size=shape) if jones else None,
        frequency_hz=CARRIER,
        transmitter=np.zeros(3),
        receiver=np.array([5.0, 1.0, -1.0]),
    )
