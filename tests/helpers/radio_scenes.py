"""Small radio scenes for tests: what propagation asks of a scene and of a material, and nothing else."""

from dataclasses import dataclass

import numpy as np
from golden.make import box_mesh as box_mesh
from golden.make import joined as joined

from warprrf.geometry.mesh import Mesh
from warprrf.rf.exact import ExactEngine
from warprrf.rf.fields.bistatic.gauss_newton import Problem
from warprrf.rf.fields.bistatic.observations import Observation, Place, Target, places_of
from warprrf.rf.fields.bistatic.training import trace
from warprrf.rf.paths.images import MirrorImages
from warprrf.rf.paths.mirror_paths import zone_paths
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import MIRROR_SLACK_M

EPSILON_0 = 8.8541878128e-12


@dataclass(frozen=True)
class SlabMaterial:
    name: str = "slab"
    relative_permittivity: float = 5.0
    conductivity: float = 0.5
    thickness_m: float = 0.1
    scattering: float = 0.0
    pattern: str = "lambertian"
    alpha_r: int = 1
    reciprocal: bool = False

    def permittivity(self, frequency_hz):
        return self.relative_permittivity - 1j * self.conductivity / (2 * np.pi * frequency_hz * EPSILON_0)

    def scattering_coefficient(self, frequency_hz):
        return self.scattering


METAL = SlabMaterial("metal", 1.0, 1e7, 0.1)


@dataclass(frozen=True)
class RadioScene:
    mesh: Mesh
    face_material: np.ndarray
    materials: list
    face_object: np.ndarray | None = None
    object_names: tuple = ()
    xml_path: object = None

    @property
    def bounds(self):
        return self.mesh.bounds


def square(half, z=0.0):
    """A horizontal square sheet, normal up."""
    v = [[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]]
    return np.array(v, float), np.array([[0, 1, 2], [0, 2, 3]])


def tube(sides, radius, height):
    """Vertices and faces of a pillar's outside, open at its ends."""
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(sides)])
    a, b = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = np.concatenate([np.column_stack([a, b, b + sides]), np.column_stack([a, b + sides, a + sides])])
    return np.concatenate([ring, ring + [0, 0, height]]), faces


def exact_spectra(scene, receivers, *, transmitter, frequency_hz, shape, sigma, sub_pixels=6):
    """Spectra of ``receivers`` by the exact engine, as a data set."""
    engine = ExactEngine(
        scene, transmitter=transmitter, frequency_hz=frequency_hz, shape=shape, beam_sigma_rad=sigma,
        sub_pixels=sub_pixels,
    )  # fmt: skip
    found = [engine.receive(r) for r in receivers]
    return SpectrumDataset.from_spectra(
        receivers=receivers, transmitter=transmitter, frequency_hz=frequency_hz,
        path_gain=np.stack([f.path_gain for f in found]), delay_s=np.stack([f.delay_s for f in found]),
        aod=np.stack([f.aod for f in found]), line_of_sight=[f.line_of_sight for f in found], beam_sigma_rad=sigma,
        engine="exact",
    )  # fmt: skip


def object_faces(scene, name):
    return np.flatnonzero(scene.face_object == scene.object_names.index(name))


def enclosed_volume(vertices, faces):
    """Signed volume [m^3]: positive where the faces of a closed surface point outwards."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def is_wound_alike(vertices, faces):
    """Whether every edge, vertices at one place (to 1e-5 m) being one, has two faces that run it in opposite directions."""
    index = np.unique(np.round(vertices, 5), axis=0, return_inverse=True)[1].reshape(-1)[faces]
    edges = [(int(f[k]), int(f[k - 1])) for f in index for k in range(3)]
    return len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)


def mirror_paths(surface, transmitter, receivers, wavelength_m, order):
    """Line of sight and mirror paths on a field's surface, softly blocked."""
    images = MirrorImages(surface.patches, transmitter, slack_m=MIRROR_SLACK_M)
    return zone_paths(images, receivers, order, wavelength_m)


def observation(view, measured, floor, db=None, **how):
    """What ``measured`` reads of ``view``: ``db`` above the floor, by default nothing."""
    tracer = view.tracer
    place = Place(
        0,
        np.zeros(1, int),
        tracer.transmitter,
        view.receivers[0],
        tracer.frequency_hz,
        tracer.grid.shape,
        None,
    )
    count = len(measured.of_bins(np.zeros((measured.bins(view)[1], 1))))
    return Observation(place, view, measured, Target(np.zeros(count) if db is None else db), floor, **how)


def seen(scene, ds, **how):
    """Places of ``ds`` and what a fit sees there."""
    return trace(Surface.of(scene), places_of([ds], scene.mesh, None), **how)[0]


def as_fits_predict(o, effects, p):
    """Readings of an observation as a fit predicts them of parameters of groups, in units of the floor."""
    ((*_, power),) = Problem.of([o], effects, np.arange(len(p.log_excess)), p).evaluated(p)
    return power
