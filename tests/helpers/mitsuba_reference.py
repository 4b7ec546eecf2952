"""Path gain of Lambertian surfaces and mirrors by Mitsuba's integrators, which share no line with ours, and by quadrature.

Sequences are named from transmitter to receiver. Mitsuba's `path` starts at the receiver and connects what it meets to
the transmitter, a point light: S, SS, SSS and SM, but nothing that a mirror lights. Its `ptracer` starts at the
transmitter and connects what it meets to the receiver: MS. Sequences are differences of scenes and of depths with the
same random numbers. Where the source gives an irradiance of cos(theta_i) / d1^2, radiance times (lambda / 4 pi)^2 is
path gain per solid angle.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.lobby.photos import mitsuba
from warprrf.rf.em.waves import SPEED_OF_LIGHT

SCATTER, MIRROR, BLACK = 0, 1, 2
"""What a face does with the power that it reflects: all as Lambert, all as a mirror, nothing."""


@dataclass(frozen=True)
class Link:
    """A room and its ends.

    Attributes:
        mesh: surfaces, of both sides.
        does: :data:`SCATTER`, :data:`MIRROR` or :data:`BLACK` for each face, shape ``(F,)``.
        transmitter, receiver: positions [m], shape ``(3,)``.
        frequency_hz: carrier.
        permittivity: of all surfaces, half-spaces.
        shape: rows and columns of a spectrum.
    """

    mesh: wr.Mesh
    does: np.ndarray
    transmitter: np.ndarray
    receiver: np.ndarray
    frequency_hz: float
    permittivity: float = 201.0
    shape: tuple[int, int] = (90, 180)

    @property
    def friis(self) -> float:
        """Path gain over a metre."""
        return (SPEED_OF_LIGHT / self.frequency_hz / (4.0 * np.pi)) ** 2


@dataclass(frozen=True)
class Estimate:
    """Path gain from independent runs: before any beam, shape ``(N, H, W)``."""

    runs: np.ndarray

    def __sub__(self, other: "Estimate") -> "Estimate":
        return Estimate(self.runs - other.runs)

    @property
    def image(self) -> np.ndarray:
        return self.runs.mean(axis=0)

    @property
    def total(self) -> float:
        return float(self.image.sum())

    @property
    def error(self) -> float:
        """Standard error of the total."""
        return float(self.runs.sum(axis=(1, 2)).std(ddof=1) / np.sqrt(len(self.runs)))


def mitsuba_sequences(link: Link, samples: int, scatterings: int, runs: int = 8) -> dict[str, Estimate]:
    """S, SM, MS and, of as many ``scatterings``, SS and SSS, from ``runs`` times ``samples`` paths per pixel."""
    dark = replace(link, does=np.where(link.does == MIRROR, BLACK, link.does))
    with mitsuba("llvm_ad_mono") as mi:
        _register(mi)

        def traced(link: Link, bounces: int, times: int = 1, **how: Any) -> Estimate:
            return _traced(mi, link, bounces, times * samples, runs, **how)

        def second(times: int, **how: Any) -> Estimate:
            """What a second bounce adds where there is one scattering."""
            both, one = (traced(link, n, times, once=True, **how) for n in (2, 1))
            return both - one

        upto = [traced(dark, n) for n in range(1, scatterings + 1)]
        lit = second(8, integrator="ptracer", light=_toward_mirrors(mi, link))
        further = {"S" * n: upto[n - 1] - upto[n - 2] for n in range(2, scatterings + 1)}
        return {"S": upto[0], "SM": second(4), "MS": lit, **further}


def _toward_mirrors(mi, link: Link) -> dict[str, Any]:
    """A light as strong as the transmitter that shines on the mirrors, and not everywhere: less noise."""
    way = link.mesh.triangles[link.does == MIRROR].reshape(-1, 3) - link.transmitter
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    axis = way.mean(axis=0)
    angle = np.degrees(np.arccos((way @ axis).min() / np.linalg.norm(axis)))
    frame = {"origin": link.transmitter, "target": link.transmitter + axis, "up": [0.6, 0.5, 0.4]}
    return {
        "type": "spot", "cutoff_angle": angle + 2.0, "beam_width": angle + 1.0, "intensity": 1.0,
        "to_world": mi.ScalarTransform4f().look_at(**{k: mi.ScalarPoint3f(*map(float, v)) for k, v in frame.items()}),
    }  # fmt: skip


def _register(mi):
    """A sensor over the whole sphere, and a Lambertian surface whose power follows Fresnel at the transmitter's side."""
    import drjit as dr

    class Panorama(mi.Sensor):
        """Power per pixel times the number of pixels: row by zenith, column by azimuth from -pi."""

        def __init__(self, props):
            super().__init__(props)
            self.place = mi.Point3f(props["place"])

        def sample_ray(self, time, wavelength_sample, position_sample, aperture_sample, active=True):
            zenith, azimuth = np.pi * position_sample.y, 2.0 * np.pi * position_sample.x - np.pi
            (s, c), (sin, cos) = dr.sincos(zenith), dr.sincos(azimuth)
            ray = mi.Ray3f(self.place, mi.Vector3f(s * cos, s * sin, c), time, mi.Color0f())
            return ray, mi.Spectrum(2.0 * np.pi**2 * s)

        def sample_ray_differential(self, *args):
            ray, weight = self.sample_ray(*args)
            return mi.RayDifferential3f(ray), weight

        def sample_direction(self, it, sample, active=True):
            way = self.place - it.p
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p, ds.dist, ds.d = self.place, dr.norm(way), dr.normalize(way)
            ds.pdf, ds.delta = 1.0, True
            column = (dr.atan2(-ds.d.y, -ds.d.x) + np.pi) / (2.0 * np.pi)
            row = dr.acos(dr.clip(-ds.d.z, -1.0, 1.0)) / np.pi
            ds.uv = mi.Point2f(column, row) * mi.Vector2f(self.film().size())
            return ds, mi.Spectrum(1.0 / dr.square(ds.dist))

        def bbox(self):
            return mi.BoundingBox3f(self.place, self.place)

    class Lambertian(mi.BSDF):
        """Both sides alike; ``once``: what it scatters is seen, and lights nothing else."""

        def __init__(self, props):
            super().__init__(props)
            self.index, self.goes_on = props["index"], 0.0 if props["once"] else 1.0
            flag = mi.BSDFFlags
            self.m_flags = flag.DiffuseReflection | flag.FrontSide | flag.BackSide
            self.m_components = [self.m_flags]

        def reflected(self, ctx, si, wo):
            incident = wo if ctx.mode == mi.TransportMode.Radiance else si.wi
            return mi.Spectrum(mi.fresnel(dr.abs(incident.z), self.index)[0])

        def sample(self, ctx, si, sample1, sample2, active=True):
            bs = dr.zeros(mi.BSDFSample3f)
            wo = mi.warp.square_to_cosine_hemisphere(sample2)
            bs.pdf = mi.warp.square_to_cosine_hemisphere_pdf(wo)
            wo.z = dr.mulsign(wo.z, si.wi.z)
            bs.wo, bs.eta, bs.sampled_type = wo, 1.0, +self.m_flags
            return bs, self.goes_on * self.reflected(ctx, si, wo) & (active & (si.wi.z != 0.0))

        def pdf(self, ctx, si, wo, active=True):
            return dr.select(active & (si.wi.z * wo.z > 0.0), dr.abs(wo.z) / np.pi, 0.0)

        def eval(self, ctx, si, wo, active=True):
            return self.reflected(ctx, si, wo) * self.pdf(ctx, si, wo, active)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def traverse(self, callback):
            pass

        def to_string(self):
            return "Lambertian[]"

    mi.register_sensor("panorama", Panorama)
    mi.register_bsdf("lambertian", Lambertian)


def _traced(
    mi,
    link: Link,
    bounces: int,
    samples: int,
    runs: int,
    *,
    integrator: str = "path",
    once: bool = False,
    light: dict[str, Any] | None = None,
) -> Estimate:
    """Paths with 1 to ``bounces`` interactions that ``integrator`` finds; ``once``: with one scattering at most."""
    point = {"type": "point", "position": link.transmitter.tolist(), "intensity": 1.0}
    index = float(np.sqrt(link.permittivity))
    bsdf = {
        SCATTER: {"type": "lambertian", "index": index, "once": once},
        MIRROR: {"type": "twosided", "bsdf": {"type": "conductor", "eta": index, "k": 0.0}},
        BLACK: {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.0}},
    }  # fmt: skip
    scene = {
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": bounces + 1, "rr_depth": 1000, "hide_emitters": True},
        "light": light or point,
        "sensor": {
            "type": "panorama", "place": mi.ScalarPoint3f(*map(float, link.receiver)), "sampler": {"type": "independent"},
            "film": {
                "type": "hdrfilm", "height": link.shape[0], "width": link.shape[1], "pixel_format": "luminance",
                "component_format": "float32", "rfilter": {"type": "box"},
            },
        },
    }  # fmt: skip
    for kind in np.unique(link.does):
        faces = link.mesh.faces[link.does == kind]
        props = mi.Properties()
        props["bsdf"] = mi.load_dict(bsdf[int(kind)])
        part = mi.Mesh(f"part_{kind}", len(link.mesh.vertices), len(faces), props=props)
        values = mi.traverse(part)
        values["vertex_positions"] = mi.Float(np.asarray(link.mesh.vertices, np.float32).ravel())
        values["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
        values.update()
        scene[f"part_{kind}"] = part
    loaded = mi.load_dict(scene)
    found = [np.array(mi.render(loaded, spp=samples, seed=seed), float)[..., 0] for seed in range(runs)]
    return Estimate(link.friis * np.stack(found) / found[0].size)


def floor_and_mirror(permittivity: float = 201.0) -> Link:
    """A Lambertian floor of 20 x 20 m, and a mirror that stands at x = 6."""
    floor = [[-10, -10, 0], [10, -10, 0], [10, 10, 0], [-10, 10, 0]]
    mirror = [[6, -4, 0.5], [6, 4, 0.5], [6, 4, 6], [6, -4, 6]]
    mesh = wr.Mesh(np.array(floor + mirror, float), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]))
    ends = np.array([-2.0, 1.0, 3.0]), np.array([2.0, -1.0, 1.5])
    return Link(mesh, np.array([SCATTER, SCATTER, MIRROR, MIRROR]), *ends, 60e9, permittivity)


def closed_forms(link: Link, cell_m: float = 0.02) -> dict[str, float]:
    """Path gain of every sequence over :func:`floor_and_mirror` with one scattering or none: images of both ends, and
    midpoints of cells of the floor, each of which sees an image through the mirror as through a window."""
    middle = np.arange(-10.0 + cell_m / 2, 10.0, cell_m)
    floor = np.stack([*np.meshgrid(middle, middle), np.zeros((len(middle), len(middle)))], axis=-1)

    def reflected(cosine):
        root, slowed = np.sqrt(link.permittivity - 1.0 + cosine**2), link.permittivity * cosine
        return 0.5 * (((cosine - root) / (cosine + root)) ** 2 + ((slowed - root) / (slowed + root)) ** 2)

    def image(end):
        return np.array([12.0 - end[0], end[1], end[2]])

    def leg(end, mirrored):
        """Cosine on the floor, and power per square metre at perpendicular incidence."""
        way = (image(end) if mirrored else end) - floor
        length = np.linalg.norm(way, axis=-1)
        _, y, z = np.moveaxis(floor + way * ((6.0 - floor[..., 0]) / way[..., 0])[..., None], -1, 0)
        through = (np.abs(y) < 4.0) & (z > 0.5) & (z < 6.0)  # of the line that goes on to both sides
        before = floor[..., 0] < 6.0
        arrives = np.where(mirrored, through & before, ~through | before) / length**2
        share = reflected(np.abs(way[..., 0]) / length) if mirrored else 1.0
        return way[..., 2] / length, arrives * share

    def scattered(lit_by_mirror, seen_in_mirror):
        cos_in, light = leg(link.transmitter, lit_by_mirror)
        cos_out, sight = leg(link.receiver, seen_in_mirror)
        power = reflected(cos_in) * cos_in * light * cos_out * sight / np.pi
        return link.friis * cell_m**2 * float(power.sum())

    direct, mirrored = link.transmitter - link.receiver, image(link.transmitter) - link.receiver
    distance = np.linalg.norm(mirrored)
    return {
        "LOS": link.friis / float(direct @ direct),
        "M": link.friis / distance**2 * reflected(mirrored[0] / distance),
        "S": scattered(False, False), "MS": scattered(True, False), "SM": scattered(False, True), "MSM": scattered(True, True),
    }  # fmt: skip
