"""Rooms of sheets that let through: Sionna RT's paths with refraction are ours: their gain, and their delay but for the slabs'."""

import numpy as np
import pytest
from radio_scenes import box_mesh, joined
from sionna_room import placed

import warprrf as wr
from warprrf.rf.em.materials import itu_material
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.interop.sionna_engine import load_sionna_scene
from warprrf.rf.spectra.spectrum import directions_from_angles

MIRROR, THROUGH = 1, 4
MIRRORS, CROSSINGS = 2, 3
SHEETS = {
    "glass": (0.006, [(3.1, 0, 3.1, 3.0)]),
    "plasterboard": (0.0125, [(2.9, 0, 2.9, 4), (2.9, 1.7, 6, 1.7), (0, 2.2, 2.9, 2.2)]),
}
"""Thickness [m] and ends of the upright sheets in a room of 6 x 4 x 2.7 m: a pane with a gap beside it, and a flat."""
TRANSMITTER, RECEIVERS = (0.9, 0.8, 2.1), ((4.6, 2.9, 1.2), (5.2, 0.7, 1.5), (1.4, 3.3, 1.1))


def room(name):
    """Sheets in a shell of concrete; nothing scatters."""
    thickness, ends = SHEETS[name]
    upright = [np.array([[a, b, 0], [c, d, 0], [c, d, 2.7], [a, b, 2.7]], float) for a, b, c, d in ends]
    sheets = [(corners, np.array([[0, 1, 2], [0, 2, 3]])) for corners in upright]
    mesh, part = joined(box_mesh([0, 0, 0], [6, 4, 2.7], inward=True), *sheets)
    made = [itu_material("concrete", thickness_m=0.2), itu_material(name, thickness_m=thickness)]
    part = np.minimum(part, 1)
    return wr.Scene(
        mesh, [m.extrapolated() for m in made], part, face_object=part, object_names=["shell", "sheets"]
    )


def path_solver(rt, scene, frequency_hz):
    """Of Sionna's paths with as many interactions as we ask for, by receiver: power, length, arrival, departure."""
    live = placed(rt, load_sionna_scene(scene, frequency_hz=frequency_hz), TRANSMITTER, RECEIVERS)
    found = rt.PathSolver(deterministic=True)(
        live, max_depth=MIRRORS + CROSSINGS, samples_per_src=300_000, refraction=True, seed=1
    )
    codes = np.asarray(found.interactions.numpy())[:, :, 0]
    asked = ((codes == MIRROR).sum(axis=0) <= MIRRORS) & ((codes == THROUGH).sum(axis=0) <= CROSSINGS)
    asked &= np.asarray(found.valid.numpy())[:, 0]
    power = sum((np.asarray(part.numpy(), float)[:, :, 0] ** 2).sum(axis=(1, 2)) for part in found.a) / 2
    tau, *angles = (
        np.asarray(x.numpy(), float)[:, 0]
        for x in (found.tau, found.theta_r, found.phi_r, found.theta_t, found.phi_t)
    )
    arrays = (
        power,
        SPEED_OF_LIGHT * tau,
        directions_from_angles(*angles[:2]),
        directions_from_angles(*angles[2:]),
    )
    return [[values[r][asked[r]] for values in arrays] for r in range(len(RECEIVERS))]


def way(paths, k, material, frequency_hz):
    """Length of a path of ours over its points [m], and the delay of its slabs over that of the air [s]."""
    points = paths.vertices[k][np.isfinite(paths.vertices[k][:, 0])]
    steps = np.diff([paths.transmitter, *points, paths.receiver], axis=0)
    length = np.linalg.norm(steps, axis=1)
    crossed = np.flatnonzero(paths.interactions[k][: len(points)] == THROUGH)
    upright = np.abs(steps[crossed]) / length[crossed, None]
    on_x = [
        any(a == c and abs(points[i][0] - a) < 1e-9 for a, _, c, _ in SHEETS[material.name][1])
        for i in crossed
    ]
    cos = np.where(on_x, upright[:, 0], upright[:, 1])
    inside = np.sqrt(material.permittivity(frequency_hz) - (1 - cos**2)).real
    return length.sum(), (material.thickness_m * (inside - cos)).sum() / SPEED_OF_LIGHT


@pytest.mark.parametrize("name, ghz", [*(("glass", f) for f in (28, 60, 140, 300)), ("plasterboard", 28)])
def test_every_path_through_sheets_is_found(rt, name, ghz):
    scene, f = room(name), 1e9 * ghz
    link = {"transmitter": TRANSMITTER, "receivers": RECEIVERS, "frequency_hz": f}
    ours = wr.trace_paths(scene, **link, mirror_order=MIRRORS, transmissions=CROSSINGS)
    for r, (power, length, arrival, departure) in enumerate(path_solver(rt, scene, f)):
        o = ours[r]
        own, excess = np.transpose([way(o, k, scene.materials[1], f) for k in range(len(o.tau))])
        gap = np.abs(length[:, None] - own)
        gap += np.linalg.norm(arrival[:, None] - o.arrival, axis=2)
        gap += np.linalg.norm(departure[:, None] - o.departure, axis=2)
        same = gap.argmin(axis=1)
        assert len(power) > 5 and gap.min(axis=1).max() < 1e-3
        assert np.abs(10 * np.log10(power / o.power[same])).max() < 0.05
        np.testing.assert_allclose(o.tau, own / SPEED_OF_LIGHT + excess, atol=1e-14)
        strong = np.flatnonzero(o.power > 1e-2 * o.power.max())
        assert np.isin(strong, same).all()
