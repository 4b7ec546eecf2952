"""From what a receiver sees and the materials to the powers of its paths, and from those to a spectrum.

Pure functions: geometry (:class:`warprrf.rf.fields.bistatic.transport.ReceiverView`) and
:class:`warprrf.rf.fields.bistatic.materials.Materials` in, powers out. Their derivatives to the parameters are in
:mod:`warprrf.rf.fields.bistatic.response`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warprrf.rf.fields.bistatic.elements import RAYS
from warprrf.rf.fields.bistatic.materials import Materials, Parameters, mirror_power, mirror_share
from warprrf.rf.fields.bistatic.scattering import scatter, send
from warprrf.rf.fields.bistatic.transport import ReceiverView, Transport
from warprrf.rf.spectra.beam import BeamOperator


@dataclass(frozen=True)
class PathPowers:
    """Path gain of everything that receivers get, before any beam.

    Attributes:
        single: of each ray's single bounce, shape ``(R K,)``.
        mirror: of each line-of-sight and mirror path, shape ``(L,)``.
        sent: of light that surfaces got from others and send on, by the ray that sees it, shape ``(R K,)``.
        shown: what mirrors show of the illuminated scene: rays and their path gain, shape ``(M,)`` each.
        parameters: under which they are.
    """

    single: np.ndarray
    mirror: np.ndarray
    sent: np.ndarray
    shown: tuple[np.ndarray, np.ndarray]
    parameters: Parameters

    @property
    def further(self) -> np.ndarray:
        """Of everything after a first bounce, by the ray that sees it, shape ``(R K,)``."""
        return np.asarray(self.sent + np.bincount(*self.shown, minlength=len(self.sent)))


@dataclass(frozen=True)
class Rendered:
    """A spectrum with what it is made of, path gain.

    Attributes:
        powers: of its paths.
        further: of everything after a first bounce, per pixel before the beam, shape ``(H, W)``.
        image: all, after the beam, shape ``(H, W)``.
    """

    powers: PathPowers
    further: np.ndarray
    image: np.ndarray


def render(view: ReceiverView, materials: Materials, beam: BeamOperator, sent: np.ndarray | None) -> Rendered:
    """The spectrum of one receiver.

    Args:
        view: what the receiver sees.
        materials: of the surfaces.
        beam: of the receiver.
        sent: what elements send on under these materials; see :func:`sent_radiance`.
    """
    powers = path_powers(view, materials, sent)
    (image,) = images(view, powers, beam)
    return Rendered(powers, powers.further.reshape(*view.transport.grid.shape, -1).sum(axis=-1), image)


def images(view: ReceiverView, powers: PathPowers, beam: BeamOperator) -> np.ndarray:
    """Spectra (R, H, W) of the receivers of ``view``: ``powers`` through the receivers' beam.

    Raises:
        ValueError: for a view that was traced without a beam.
    """
    if view.beams is None:
        raise ValueError("view: it was traced without a receiver's beam, expected one of a spectrum")
    count, shape, paths = len(view.receivers), view.transport.grid.shape, view.paths
    pixels = np.einsum("...k->...", (powers.single + powers.further).reshape(count, *shape, -1))
    found = np.moveaxis(beam(np.ascontiguousarray(np.moveaxis(pixels, 0, -1))), -1, 0)
    sharp = powers.mirror.astype(np.float32)
    for image, own in zip(found, (paths.receiver == k for k in range(count)), strict=True):
        image += np.tensordot(sharp[own], view.beams[own], axes=1)
    return np.maximum(found, 0.0)


def path_powers(view: ReceiverView, materials: Materials, sent: np.ndarray | None) -> PathPowers:
    """Path gain of everything that the receivers of ``view`` get, residual and common gain included; arguments as for
    :func:`render`."""
    t, terms, p = view.transport, materials.terms, materials.parameters
    paths = view.paths
    mirror = mirror_power(view.friis, view.path_groups, paths.cosine, paths.turn, p)[0] * p.gain
    kept = (paths.order <= terms.mirror_order) & ((paths.order > 0) | terms.line_of_sight)
    mirror = np.where(kept, mirror, 0.0)
    face = view.hits.face.numpy()
    single = np.zeros(len(face))
    if terms.diffuse:
        power = scatter(t.surface, view.hits.face, view.light, terms, p.weight, p.log_excess, t.wavelength_m)
        single = power * (p.gain * materials.cell_gain())[t.surface.cell].take(face, mode="wrap")
    on, (ray, shown) = sent_on(view, materials, sent), mirror_shown(view, materials, sent)
    on *= (p.gain * materials.sent_gain(t.transmitter))[t.surface.cell].take(face, mode="wrap")
    return PathPowers(single, mirror, on, (ray, p.gain * shown), p)


def sent_on(view: ReceiverView, materials: Materials, sent: np.ndarray | None) -> np.ndarray:
    """Light that surfaces send on along each ray, without residual and common gain, shape ``(R K,)``."""
    t, p = view.transport, materials.parameters
    found = send(t, view.hits, sent)
    m = view.mirror_illumination if materials.terms.diffuse and materials.terms.mirror_scatter else None
    if m is not None and len(m.ray):
        power = scatter(t.surface, m.face, m.light, materials.terms, p.weight, p.log_excess, t.wavelength_m)
        power = power * mirror_share(p, t.surface.patch_group[m.patch], m.cosine)
        found += np.bincount(m.ray, power, minlength=len(found))
    return found


def mirror_shown(
    view: ReceiverView, materials: Materials, sent: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Rays, and path gain of what mirrors show there, without the common gain: first bounces, and the radiance that
    elements send on."""
    t, p, m = view.transport, materials.parameters, view.mirror_shown
    wanted = materials.terms.diffuse and materials.terms.scatter_mirror
    if not wanted or m is None or len(m.ray) == 0:
        return np.zeros(0, int), np.zeros(0)
    power = scatter(t.surface, m.hits.face, m.light, materials.terms, p.weight, p.log_excess, t.wavelength_m)
    return m.ray, mirror_share(p, m.group, m.cosine) * (power + send(t, m.hits, sent)) * m.air


def sent_radiance(transport: Transport, materials: Materials) -> np.ndarray | None:
    """Radiance that elements' sides send on besides first bounces [1/(m^2 sr)], shape ``(S,)``; None where there is none.

    Radiance is in units in which the transmitter gives an irradiance of cos(theta_i) / d1^2 [1/m^2].
    """
    terms, p, surface = materials.terms, materials.parameters, transport.surface
    if not (terms.further or terms.indirect):
        return None
    sent = np.zeros(surface.element_sides)
    group = np.tile(surface.element_group, 1 + surface.two_sided)
    if terms.further:
        sent += _element_radiance(transport, materials, p.scattered_share[group] / np.pi)
    if terms.indirect:
        sent += np.exp(p.log_indirect)[group]
    return sent


def _element_radiance(transport: Transport, materials: Materials, share: np.ndarray) -> np.ndarray:
    """Radiance of light that elements' sides got from other surfaces, one or two diffuse bounces before, shape ``(S,)``;
    ``share`` (S,) is what they send of it per steradian."""
    terms, p, wavelength = materials.terms, materials.parameters, transport.wavelength_m
    got = np.zeros(len(share))
    for rays in transport.elements.rays:
        power = scatter(
            transport.surface, rays.hits.face, rays.light, terms, p.weight, p.log_excess, wavelength
        )
        # rays are drawn by the cosine: pi times the mean radiance that they see is the irradiance
        got[rays.side] = np.pi * (power.reshape(-1, RAYS) * (4.0 * np.pi / wavelength) ** 2).mean(axis=1)
    if terms.diffuse_order > 2:
        before = share * (got + transport.mirror_light.irradiance(p) if terms.mirror_scatter else got)
        for rays in transport.elements.rays:
            got[rays.side] += np.pi * (before[rays.met] * rays.air).mean(axis=1)
    return share * got
