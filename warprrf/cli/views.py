"""`warprrf view`, `render`, `map`, `twin`: what a field or a reconstruction gives to look at and to take elsewhere."""

from __future__ import annotations

import argparse
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from warprrf.cli.inputs import (
    Add,
    add_frequency,
    add_measured_options,
    add_out,
    add_point,
    beside,
    existing,
    load_field,
    read_measured,
    refuse,
)
from warprrf.cli.output import Output, aligned
from warprrf.device import require
from warprrf.files import write_arrays, write_atomically
from warprrf.rf.spectra.spectrum import pixel_directions, to_db


def add_render(add: Add) -> None:
    """Define `render`."""
    ren = add("render", _render)
    ren.add_argument(
        "source", help="Gaussians (.ply, or a reconstruction's folder) or a radio field (.safetensors)"
    )
    add_out(ren, "picture (.png), or for a spectrum also .npz")
    add_point(ren, "--receiver", "where the spectrum is taken")
    add_point(ren, "--transmitter", "if another than the fitted one")
    add_frequency(ren, "another carrier than the field's own")
    ren.add_argument(
        "--array",
        nargs=2,
        type=int,
        metavar=("ROWS", "COLS"),
        help="what a coherent array hears, phases and all",
    )
    ren.add_argument(
        "--facing", nargs=2, type=float, metavar=("AZIMUTH", "ELEVATION"), help="of the array, degrees (0 90: up)",
    )  # fmt: skip
    add_point(ren, "--position", "where the camera stands")
    add_point(ren, "--look-at", "a point it looks at")
    ren.add_argument("--size", nargs=2, type=int, metavar=("W", "H"), help="pixels (640 480)")
    ren.add_argument("--field-of-view", type=float, help="horizontal, degrees (default 75)")


def _render(args: argparse.Namespace, out: Output) -> None:
    """A picture from Gaussians, or a spectrum from a radio field.

    examples:
      warprrf render field.safetensors --receiver 7 4 1.5 -o spectrum.png
      warprrf render field.safetensors --receiver 7 4 1.5 -o spectrum.npz       path_gain, delay_s, aod as arrays
      warprrf render field.safetensors --receiver 7 4 1.5 -o other.png --transmitter 2 3 3.2 --frequency 140e9
      warprrf render field.safetensors --receiver 7 4 1.5 -o array.png --array 4 4
      warprrf render room --position 2 2 1.6 --look-at 8 6 1.2 -o view.png
      warprrf render splats.ply --position 2 2 1.6 --look-at 8 6 1.2 -o view.png --size 1280 720
    """
    source, path = existing(args.source), Path(args.out)
    of_field = source.suffix.lower() == ".safetensors"
    kinds = ".png (a picture)", ".npz (path_gain, delay_s, aod)" if of_field else ".jpg (a smaller one)"
    if path.suffix.lower() not in (kind.split()[0] for kind in kinds):
        raise ValueError(f"{path}: expected {' or '.join(kinds)}")
    others = (
        ("position", "look_at", "size", "field_of_view")
        if of_field
        else ("receiver", "transmitter", "frequency", "array")
    )
    refuse(args, others, f"{source} is {'a' if of_field else 'no'} radio field")
    if args.array is None:
        refuse(args, ["facing"], "no --array is given")
    if of_field:
        if args.receiver is None:
            raise ValueError("--receiver: none given, expected three coordinates in metres for a radio field")
        field, place = load_field(source, args), np.array(args.receiver, dtype=np.float64)
        if args.array is None:
            spectrum = field.spectrum(place, args.transmitter)
            name, gain = "total path gain", spectrum.total_path_gain
        else:
            spectrum = _array_spectrum(field, place, args)
            name, gain = "strongest direction", spectrum.path_gain.max()
        _write_spectrum(spectrum, path)
        db = float(to_db(gain))
        text = f"{args.out}: {name} {db:.2f} dB at {' '.join(f'{x:g}' for x in args.receiver)}"
        out.result(text, files=[args.out], **{f"{name.replace(' ', '_')}_db": db})
        return
    if args.position is None or args.look_at is None:
        raise ValueError("--position and --look-at: both are needed to draw Gaussians, three numbers each")
    gaussians = wr.Reconstruction.load(source).gaussians if source.is_dir() else wr.Gaussians.load_ply(source)
    width, height = args.size or (640, 480)
    fov_deg = 75.0 if args.field_of_view is None else args.field_of_view
    camera = _look_at(args.position, args.look_at, (width, height), fov_deg)
    image = wr.render(gaussians, camera, device=args.device).features
    from PIL import Image

    pixels = np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    write_atomically(path, lambda name: Image.fromarray(pixels).save(name))
    text = f"{args.out}: {width} x {height} pixels, {len(gaussians.means)} Gaussians"
    out.result(text, files=[args.out], Gaussians=len(gaussians.means))


def _array_spectrum(field: Any, place: np.ndarray, args: argparse.Namespace) -> wr.Spectrum:
    if field.model != "bistatic":
        raise ValueError(f"--array: got model {field.model}, which knows no phases; expected bistatic")
    azimuth, elevation = np.radians(args.facing or (0.0, 90.0))
    rows, columns = args.array
    array = wr.PlanarArray(rows, columns, orientation=(azimuth, -elevation, 0.0))
    heard = field.array_spectrum(place, array, pixel_directions(field.shape), args.transmitter)
    return wr.Spectrum(heard, floor=field.floor, range_db=field.range_db)


def _write_spectrum(spectrum: wr.Spectrum, path: Path) -> None:
    if path.suffix.lower() == ".npz":
        write_arrays(path, {n: array for n, array in vars(spectrum).items() if isinstance(array, np.ndarray)})
        return
    figure = require("matplotlib.figure", extra="plots").Figure(figsize=(8.0, 4.2), layout="constrained")
    spectrum.plot(ax=figure.add_subplot())
    write_atomically(path, lambda name: figure.savefig(name, dpi=130))


def _look_at(
    position: Sequence[float], target: Sequence[float], size: tuple[int, int], fov_deg: float
) -> Any:
    """A pinhole camera at `position` that looks at `target`, z up; `fov_deg` is horizontal."""
    if not 0.0 < fov_deg < 180.0:
        raise ValueError(f"--field-of-view: got {fov_deg}, expected degrees between 0 and 180")
    eye, goal = np.array(position, dtype=np.float64), np.array(target, dtype=np.float64)
    forward = goal - eye
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-9:
        raise ValueError("--look-at: straight above or below --position (or equal to it); move it sideways")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, -rotation @ eye
    focal = 0.5 * size[0] / np.tan(0.5 * np.deg2rad(fov_deg))
    return wr.Camera.pinhole(
        *size, fx=focal, fy=focal, cx=0.5 * size[0], cy=0.5 * size[1], world_to_camera=world_to_camera
    )


def add_view(add: Add) -> None:
    """Define `view`."""
    viewer = add("view", _view)
    viewer.add_argument(
        "things",
        nargs="+",
        help="folder of a reconstruction or of `make lobby`, mesh, scene, field, spectra or readings (CSV)",
    )
    add_measured_options(viewer)
    viewer.add_argument(
        "--port", type=int, default=8080, help="of the page; the next free one if taken (default 8080)"
    )
    viewer.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (default 127.0.0.1: this machine alone)"
    )
    viewer.add_argument("--no-browser", action="store_true", help="only say where the page is")


def _view(args: argparse.Namespace, out: Output) -> None:
    """Everything in the browser: drag a receiver, see its spectrum, paths, delays and errors.

    Ctrl-C ends it.

    examples:
      warprrf view runs/lobby data/lobby/spectra.nc      what `make lobby` made, the truth beside it
      warprrf view room.glb field.safetensors
      warprrf view room.glb field.safetensors horn.csv --frequency 300e9 --noise-floor-db -120 --receive-pattern 10
    """
    viewer = wr.view(*read_measured(args.things, args, others=True), host=args.host, port=args.port)
    out.result(f"{viewer.url}   (Ctrl-C ends it)", url=viewer.url)
    if not args.no_browser:
        webbrowser.open(viewer.url)
    try:
        viewer.serve()
    finally:
        viewer.close()


def add_map(add: Add) -> None:
    """Define `map`."""
    plan = add("map", _map)
    plan.add_argument("field", help="field file (.safetensors)")
    add_out(plan, "NetCDF file (.nc), or the picture alone (.png)")
    plan.add_argument("--height", type=float, default=1.5, metavar="M", help="of receivers (default 1.5)")
    plan.add_argument(
        "--above-ground", action="store_true", help="heights count from the ground, not from z = 0"
    )
    plan.add_argument("--cell", type=float, default=0.25, metavar="M", help="width of a cell (default 0.25)")
    add_point(plan, "--transmitter", "if another than the fitted one")
    add_frequency(plan, "another carrier than the field's own")
    plan.add_argument(
        "--bounds", nargs=4, type=float, metavar=("X0", "Y0", "X1", "Y1"), help="part of the plan, metres"
    )
    plan.add_argument("--beam-sigma-deg", type=float, default=2.0, help="receive beam (default 2 degrees)")
    plan.add_argument("--power-dbm", type=float, default=20.0, help="isotropic transmitter (default 20)")
    plan.add_argument(
        "--bandwidth", type=float, default=2.16e9, metavar="HZ", help="of noise (default 2.16e9)"
    )
    plan.add_argument(
        "--noise-figure", type=float, default=10.0, metavar="DB", help="of receivers (default 10)"
    )
    plan.add_argument(
        "--mirror-order", type=int, choices=range(4), help="most mirrors on a path (default the field's own)"
    )


def _map(args: argparse.Namespace, out: Output) -> None:
    """A field's radio map over the floor plan.

    Total path gain, the strongest path's gain, delay spread and the SNR of the receiver's best beam, at the centres of
    cells; NaN inside solids and outside the room, as the field's mesh has them. A NetCDF file gets a picture beside it.

    examples:
      warprrf map field.safetensors -o map.nc --height 1.5 --cell 0.25
      warprrf map field.safetensors -o corner.png --bounds 0 0 5 4 --cell 0.1 --transmitter 2 3 3.2
    """
    path = Path(args.out)
    if path.suffix.lower() not in (".nc", ".png"):
        raise ValueError(f"{path}: expected .nc (NetCDF, a picture beside it) or .png (the picture alone)")
    files = [path] if path.suffix.lower() == ".png" else [path, beside(args.out, ".png")]
    field = load_field(args.field, args)
    found = field.radio_map(
        args.height,
        args.cell,
        transmitter=args.transmitter,
        bounds=args.bounds,
        above_ground=args.above_ground,
        beam_sigma_rad=np.deg2rad(args.beam_sigma_deg),
        transmit_power_dbm=args.power_dbm,
        bandwidth_hz=args.bandwidth,
        noise_figure_db=args.noise_figure,
        mirror_order=args.mirror_order,
        progress=out,
    )
    if path.suffix.lower() == ".nc":
        found.save(path)
    found.picture(files[-1])
    gain, snr = (found.plot_values(name)[found.free] for name in ("total_path_gain", "best_beam_snr_db"))
    figures = {"median_total_path_gain_db": np.median(gain), "median_best_beam_snr_db": np.median(snr)}
    out.result(
        f"{path}: {found.free.sum()} cells in the air of {found.free.size}; median total path gain "
        f"{np.median(gain):.1f} dB, median SNR of the best beam {np.median(snr):.1f} dB, lowest {snr.min():.1f} dB",
        files=files, cells=found.free.size, cells_in_air=found.free.sum(), **figures, lowest_best_beam_snr_db=snr.min(),
    )  # fmt: skip


def add_twin(add: Add) -> None:
    """Define `twin`."""
    twin = add("twin", _twin)
    twin.add_argument("field", help="field file (.safetensors) of model bistatic")
    twin.add_argument(
        "--thickness", nargs="+", default=[], metavar="M",
        help="thickness of all surfaces, or NAME=M of some [m]; by default that of the scene that the field was fitted on",
    )  # fmt: skip
    add_out(twin, "folder of the twin: new, empty or an earlier twin's")
    add_frequency(twin, "another carrier than the field's own")


def _twin(args: argparse.Namespace, out: Output) -> None:
    """A field's digital twin: a scene for Sionna RT.

    Writes the reconstructed mesh with the fitted materials as scene.xml, materials.json and meshes/. `sionna.rt.load_scene`
    opens the scene as it is, all lobes Lambertian; `warprrf.interop.load_sionna_scene` sets the scattering patterns too, and
    `warprrf simulate` takes it as any scene. A material has one curve and one lobe: what the projection misses is printed.

    examples:
      warprrf twin field.safetensors -o twin
      warprrf twin field.safetensors -o twin --thickness glass=0.01 walls=0.1
      warprrf simulate twin/scene.xml -o spectra.nc --transmitter 2 3 3.2 --receivers receivers.csv --engine sionna
    """
    twin = wr.interop.write_twin(
        load_field(args.field, args), args.out, thickness_m=_thickness(args.thickness)
    )
    rows = [["surface", "area m2", "thickness m", "permittivity", "S", "lobe", "lobe error dB"]]
    for group in twin.groups:
        rows.append(
            [
                group.name,
                f"{group.area_m2:.1f}",
                f"{group.thickness_m:.3g}",
                f"{group.permittivity.real:.3g}",
                f"{group.scattering:.3f}",
                f"{group.alpha_r}" if group.alpha_r else "Lambertian",
                f"{group.lobe_error_db:.2f}",
            ]
        )
    figures = {
        name: getattr(twin, name) for name in ("scattering_error_db", "mirror_error_db", "lobe_error_db")
    }
    scattered, mirrored, lobes = figures.values()
    lines = [
        aligned(rows),
        f"\n{twin.xml}: {len(twin.groups)} materials; rms errors of the projection over area: scattered power "
        f"{scattered:.2f} dB, mirrored power {mirrored:.2f} dB, lobes {lobes:.2f} dB",
        *(f"left out: {line}" for line in twin.left_out),
    ]
    out.result(
        "\n".join(lines), files=[args.out], materials=len(twin.groups), **figures, left_out=twin.left_out
    )


def _thickness(words: list[str]) -> float | dict[str, float] | None:
    """``["0.1"]`` as one number, ``["glass=0.01", ...]`` by name; None for no words."""
    try:
        if len(words) == 1 and "=" not in words[0]:
            return float(words[0])
        found = {name: float(value) for name, value in (word.rsplit("=", 1) for word in words)}
        if len(found) < len(words):
            raise ValueError("a name twice")
        return found or None
    except ValueError as error:
        raise ValueError(f"--thickness: got {' '.join(words)}, expected M, or NAME=M of each") from error
