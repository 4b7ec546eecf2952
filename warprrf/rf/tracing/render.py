"""From what receivers see and a model to the path gains that they get, and from those to spectra."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from warprrf.rf.spectra.beam import BeamOperator
from warprrf.rf.tracing.interreflection import irradiance
from warprrf.rf.tracing.model import Model, Parameters
from warprrf.rf.tracing.records import Materials, Records
from warprrf.rf.tracing.tracer import SPECULAR, Tracer, View


@dataclass(frozen=True)
class PathGains:
    """Path gain of all that receivers get, before any beam.

    Attributes:
        view: what they see.
        tables: of each record, by sequence; see :class:`View`.
        records: by sequence.
        parameters: under which they are.
    """

    view: View
    tables: dict[str, np.ndarray]
    records: dict[str, Records]
    parameters: Parameters

    @property
    def specular(self) -> np.ndarray:
        """Of each line of sight and mirror path, shape ``(L,)``."""
        return self.tables[SPECULAR]

    @property
    def apart(self) -> list[PathGains]:
        """Those of each receiver, all that is scattered in one table."""
        rays, found = self.by_ray().reshape(len(self.view.receivers), -1), list[PathGains]()
        index, none = np.arange(rays.shape[1]), np.zeros((rays.shape[1], 0), np.int32)
        for k, power in enumerate(rays):
            view, direct = self.view.of(k), self.specular[self.view.paths.receiver == k]
            every = Records(power, index, none, np.zeros((*none.shape, 3)), none[:1])
            records = view.records | {"rays": every}
            found.append(PathGains(view, {SPECULAR: direct, "rays": power}, records, self.parameters))
        return found

    def by_ray(self, names: Iterable[str] | None = None) -> np.ndarray:
        """Of everything but those, or of the sequences ``names``, by the ray that sees it, shape ``(R K,)``."""
        count, records = len(self.view.hits.face), self.records
        chosen = [n for n in (self.tables if names is None else names) if n != SPECULAR and n in self.tables]
        return sum((np.bincount(records[n].ray, self.tables[n], count) for n in chosen), np.zeros(count))

    @property
    def single(self) -> np.ndarray:
        """Of what the transmitter lights and the receiver sees directly, by ray, shape ``(R K,)``."""
        return self.by_ray(["S"])


def materials_of(tracer: Tracer, model: Model) -> Materials:
    """The parameters of ``model`` under a transmitter, as kernels take them."""
    p, surface = model.parameters, tracer.surface
    got = irradiance(tracer, p, model.effects)
    if got is None:
        return Materials(p, tracer.slabs, device=tracer.grid.device)
    radiance = got * p.scattered_share[surface.side_group] / np.pi
    return Materials(p, tracer.slabs, None, surface.side_group, radiance, device=tracer.grid.device)


def path_gains(view: View, model: Model, materials: Materials) -> PathGains:
    """What the receivers of ``view`` get, residual and common gain included.

    Args:
        view: what they see.
        model: effects, parameters and residual.
        materials: :func:`materials_of` it under the view's transmitter.
    """
    t, found = view.tracer, {}
    gains = model.cell_gains(t.transmitter)
    tables = view.traced(model.effects)
    for name, records in tables.items():
        power = records.powers(materials)
        row = records.residual_row
        found[name] = power * (gains[row, view.cell[records.ray]] if row >= 0 else model.parameters.gain)
    found[SPECULAR] = np.where(view.kept_paths(model.effects), found[SPECULAR], 0.0)
    return PathGains(view, found, tables, model.parameters)


def images(gains: PathGains, beam: BeamOperator) -> np.ndarray:
    """Spectra (R, H, W) of the receivers: path gains through the receivers' beam.

    Raises:
        ValueError: for a view that was traced without a beam.
    """
    view = gains.view
    count, shape = len(view.receivers), view.tracer.grid.shape
    pixels = np.einsum("...k->...", gains.by_ray().reshape(count, *shape, -1))
    found = np.moveaxis(beam(np.ascontiguousarray(np.moveaxis(pixels, 0, -1))), -1, 0)
    specular = gains.specular.astype(np.float32)
    for image, own in zip(found, (view.paths.receiver == k for k in range(count)), strict=True):
        image += np.tensordot(specular[own], view.beams[own], axes=1)
    return np.maximum(found, 0.0)
