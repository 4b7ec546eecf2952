"""Diffraction by the straight edge of a wedge: uniform coefficients, as facts of the edge's angles and distances alone.

Source: R. G. Kouyoumjian and P. H. Pathak, "A uniform geometrical theory of diffraction for an edge in a perfectly
conducting surface", Proc. IEEE 62 (1974), eqs. (25) to (35). Faces that do not conduct perfectly get the heuristic of
R. J. Luebbers, "Finite conductivity uniform GTD versus knife edge diffraction in prediction of propagation path loss",
IEEE Trans. AP 32 (1984): the two terms of the coefficient that make the field continuous where a face's mirror image ends are
multiplied by that face's reflection. The other two carry the straight path; of a sheet that lets a part through they are
multiplied by what it stops.

A face's coefficient is taken at one angle between those of the incident and of the diffracted ray, so that the field is
reciprocal. Why, and what is missing, says ``docs/theory/radio.md`` (Diffraction).

The time factor is exp(+j 2 pi f t). Fields at either end are along two vectors fixed to the edge, (b, p) with p = e x s
and b = s x p, e being the edge's unit vector and s the direction of propagation: b has the sign of the field along the
edge ("soft": zero on a conductor), p that of the magnetic field along it ("hard").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import wofz

ON_BOUNDARY = 1e-12
"""Nearer than this to where a path ends it counts as there [rad]: half of its field is left, not all or nothing."""
Pair = tuple[np.ndarray, np.ndarray]
"""Coefficients of fields across (TE) and in (TM) the plane of incidence."""


@dataclass(frozen=True)
class EdgeRays:
    """L rays over edges, each with the wedge that it meets; arrays of shape ``(L,)``, or numbers.

    Attributes:
        n: Exterior angle of the wedge over pi: 2 for a sheet's border, 1.5 for a box's edge.
        incident: Angle phi' from face 0, through the air, to the transmitter [rad], in [0, n pi].
        diffracted: The same to the receiver, phi [rad].
        cosine: Cosine of the angle between the edge's unit vector e and the direction of propagation, alike for both legs
            (Keller's cone). About e, phi grows.
        before: Length of the way to the edge, unfolded at mirrors [m]; inf for a plane wave.
        behind: Length of the way from there on [m].
        wavelength_m: Wavelength [m].
    """

    n: np.ndarray
    incident: np.ndarray
    diffracted: np.ndarray
    cosine: np.ndarray
    before: np.ndarray
    behind: np.ndarray
    wavelength_m: float

    @property
    def share(self) -> np.ndarray:
        """s / (s + s'), shape ``(L,)``."""
        return np.asarray(1.0 / (1.0 + np.asarray(self.before) / self.behind))

    @property
    def _boundaries(self) -> list[np.ndarray]:
        """Angles past the four boundaries [rad]: the straight path stopped by face 0 and by face n, the images in them."""
        straight, image = self.diffracted - self.incident, self.diffracted + self.incident
        return [
            np.pi - straight,
            np.pi + straight,
            np.pi - image,
            np.pi + image - 2.0 * np.pi * np.asarray(self.n),
        ]

    @property
    def _slants(self) -> list[np.ndarray]:
        """Angles to the faces' planes that coefficients are taken at [rad], one for each boundary."""
        mean = self.share * self.diffracted + (1.0 - self.share) * self.incident
        other = (1.0 - self.share) * self.incident - self.share * self.diffracted
        far = np.pi * np.asarray(self.n) * (1.0 - 2.0 * self.share)
        return [
            mean - np.pi * self.share,
            mean - np.pi * (1.0 - self.share),
            other + np.pi * self.share,
            far - other + np.pi * self.share,
        ]

    def incidence_cosines(self) -> np.ndarray:
        """Cosines of incidence at which the faces' coefficients are wanted, shape ``(4, ...)``: of transmission from the
        side of face 0 and of face n, of reflection by face 0 and by face n."""
        # Where the slant passes through 0, far from its boundary, |sin| alone would have a kink.
        angles = zip(self._slants, self._boundaries, strict=True)
        bent = [1.0 - np.cos(a) ** 2 * (1.0 - np.sin(0.5 * d) ** 4) for a, d in angles]
        return np.sqrt((1.0 - np.asarray(self.cosine) ** 2) * np.stack(np.broadcast_arrays(*bent)))


def boundary_fields(rays: EdgeRays) -> np.ndarray:
    """The four terms of the coefficient, shape ``(4, ...)``, complex, in the order of :meth:`EdgeRays.incidence_cosines`.

    Each is the diffracted field over that of a wave which came as far, s + s', without an edge: a coefficient's term times
    sqrt((s + s') / (s s')). It jumps from -1/2 to 1/2 where a path ends; a conductor's field is the first two less
    (soft) or with (hard) the last two. Source: Kouyoumjian and Pathak, eqs. (25), (31) and (35), with
    cot(x / 2n) F(2 k L sin(x / 2)^2) written so that it stays finite at the boundary.
    """
    n, sine_sq = np.asarray(rays.n), 1.0 - np.asarray(rays.cosine) ** 2
    parameter = np.asarray(rays.behind) * (1.0 - rays.share) * sine_sq  # L
    root = np.sqrt(4.0 * np.pi / rays.wavelength_m * parameter)
    terms = []
    for x in rays._boundaries:
        x = x - 2.0 * np.pi * n * np.rint(x / (2.0 * np.pi * n))
        x = np.where(np.abs(x) < ON_BOUNDARY, ON_BOUNDARY, x)
        size = np.abs(np.sin(0.5 * x))
        slope = size / np.tan(0.5 * x / n)
        terms.append(-0.5 / n * slope * wofz(np.exp(0.75j * np.pi) * root * size))
    return np.stack(np.broadcast_arrays(*terms))


def diffraction_matrices(
    rays: EdgeRays, reflected: Sequence[Pair], through: Sequence[Pair] | None = None
) -> np.ndarray:
    """What an edge makes of a field: matrices ``(..., 2, 2)`` from (b, p) of the incident to that of the diffracted ray.

    Times exp(-j k (s + s')) / (s + s') and the strength of the source, they give the field; the spreading factor is in them.

    Args:
        rays: Angles and distances.
        reflected: Reflection of face 0 and of face n, TE and TM each, at the cosines that ``rays`` ask for; -1 and 1 for a
            conductor.
        through: Transmission, of a sheet, from the side of face 0 and of face n; None if nothing goes through.
    """
    terms = boundary_fields(rays)
    slants, cosine = rays._slants, np.asarray(rays.cosine)
    result = np.zeros((*terms.shape[1:], 2, 2), complex)
    for k in range(2):
        turned, crossed = _turned(slants[k], cosine)
        passed = (np.zeros(()), np.zeros(())) if through is None else through[k]
        mean, half = 0.5 * (passed[0] + passed[1]), 0.5 * (passed[0] - passed[1])
        result[..., 0, 0] += terms[k] * (1.0 - mean - half * turned)
        result[..., 1, 1] += terms[k] * (1.0 - mean + half * turned)
        result[..., [0, 1], [1, 0]] -= (terms[k] * half * crossed)[..., None]
        # A face n has its edge's vector the other way round.
        turned, crossed = _turned(slants[2 + k], cosine if k == 0 else -cosine)
        mean, half = 0.5 * (reflected[k][0] + reflected[k][1]), 0.5 * (reflected[k][0] - reflected[k][1])
        result[..., 0, 0] += terms[2 + k] * (mean * turned + half)
        result[..., 1, 1] += terms[2 + k] * (mean * turned - half)
        result[..., 0, 1] += terms[2 + k] * mean * crossed
        result[..., 1, 0] -= terms[2 + k] * mean * crossed
    return result


def _turned(slant: np.ndarray, cosine: np.ndarray) -> Pair:
    """Cosine and sine of twice the angle from the edge-fixed b to the TE field of a face met under ``slant``."""
    along, across = np.cos(slant), cosine * np.sin(slant)
    square = along**2 + across**2
    # Met head on, a face has no plane of incidence: TE is along the edge.
    safe = np.where(square > 0, square, 1.0)
    return np.where(square > 0, (along**2 - across**2) / safe, 1.0), 2.0 * along * across / safe
