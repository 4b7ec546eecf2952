"""The command line: every step of the library as a command, and the lobby as one.

`main` parses, calls one public function and writes what came back; nothing is computed here. Bad input ends with one
line on standard error and status 2 (`--debug` shows the traceback instead), an interrupt with 130.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from warprrf.bench.stages import write_atomically, write_json
from warprrf.cli_bars import Bars
from warprrf.cli_bench import add_benches
from warprrf.cli_help import (
    HELP_DATA,
    HELP_EVALUATE,
    HELP_FIT,
    HELP_LOBBY,
    HELP_MAP,
    HELP_RECONSTRUCT,
    HELP_RELEVANCE,
    HELP_RENDER,
    HELP_SIMULATE,
    HELP_TWIN,
)
from warprrf.device import require

EPILOG = """\
a walk through, in a checkout:
  warprrf lobby                                    photos -> geometry -> radio -> evaluation, into runs/lobby/
  warprrf reconstruct photos/ -o room --known-positions surveyed.json
  warprrf simulate data/lobby/scene.xml -o spectra.nc --transmitter 2 3 3.2 --receivers receivers.csv
  warprrf fit room spectra.nc -o field.safetensors --model rf3dgs+
  warprrf evaluate field.safetensors spectra.nc --train 50
  warprrf render field.safetensors --receiver 7 4 1.5 -o spectrum.png
  warprrf map field.safetensors -o map.nc --height 1.5 --cell 0.25
  warprrf twin field.safetensors -o twin           scene.xml and materials.json for Sionna RT

Metres, seconds, hertz, world z up. `warprrf COMMAND --help` explains each with examples.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0 done, 2 bad input, 130 interrupted."""
    parser = _parser()
    args = parser.parse_args(argv)
    try:
        with Bars(quiet=args.quiet) as bars:
            args.command(args, bars)
    except KeyboardInterrupt:
        print("warprrf: interrupted; what is finished is kept", file=sys.stderr)
        return 130
    except (ValueError, OSError, ImportError) as error:
        if args.debug:
            raise
        print(f"warprrf: error: {_one_line(error)}", file=sys.stderr)
        return 2
    return 0


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


# --------------------------------------------------------------------------------------------------- the commands


def _lobby(args: argparse.Namespace, bars: Bars) -> None:
    from warprrf.bench.lobby import pipeline

    report = pipeline.run(
        args.out,
        args.data,
        seed=args.seed,
        device=args.device,
        progress=bars,
        reduced=args.reduced,
        fresh=args.fresh,
    )
    bars.close()
    print(pipeline.summary(report))
    for truth, key in (("exact", "methods"), ("Sionna RT", "methods_sionna")):
        print(f"\nheld-out receivers, truth: {truth}\n{table(report[key])}")
    print(f"\n{Path(args.out) / 'report.html'}: the report with pictures; report.json: every figure")


def _data(args: argparse.Namespace, bars: Bars) -> None:
    from warprrf.bench.lobby import make_data

    make_data.run(args.data, steps=args.only, full=args.full, progress=bars, device=args.device)


def _reconstruct(args: argparse.Namespace, bars: Bars) -> None:
    known = _read_positions(args.known_positions) if args.known_positions else None
    photos = _existing(args.photos)
    workspace = args.workspace or Path(args.out) / "workspace"
    reconstruction = wr.reconstruct(
        photos, workspace=workspace, known_positions=known, seed=args.seed, progress=bars, device=args.device
    )
    reconstruction.save(args.out)
    print(
        f"{args.out}: {len(reconstruction.cameras)} cameras, {len(reconstruction.gaussians.means)} Gaussians, "
        f"{len(reconstruction.mesh.faces)} triangles"
    )


def _simulate(args: argparse.Namespace, bars: Bars) -> None:
    unfinished = Path(f"{args.out}.receivers")
    dataset = wr.simulate(
        wr.Scene.load(_existing(args.scene)),
        transmitter=np.array(args.transmitter, dtype=np.float64),
        receivers=_read_receivers(args.receivers),
        frequency_hz=args.frequency,
        shape=tuple(args.shape),
        engine=args.engine,
        depth=args.depth,
        samples=args.samples,
        beam_sigma_rad=np.deg2rad(args.beam_sigma_deg),
        refraction=args.refraction,
        seed=args.seed,
        gas=args.gas,
        workspace=unfinished,
        progress=bars,
        device=args.device,
    )
    dataset.save(args.out)
    shutil.rmtree(unfinished)  # the finished receivers of a killed run are not needed any more
    print(f"{args.out}: {len(dataset)} spectra of {args.shape[0]} x {args.shape[1]} pixels, {args.engine}")


def _fit(args: argparse.Namespace, bars: Bars) -> None:
    geometry = _load_geometry(args.geometry, args.mesh)
    dataset = wr.SpectrumDataset.load(_existing(args.spectra))
    if args.train is not None:
        dataset = dataset.split(args.train, seed=args.seed)[0]
    ruled = {} if args.relevance is None else {"relevance": wr.Relevance.load(_existing(args.relevance))}
    if ruled and args.model != "bistatic":
        raise ValueError(f"--relevance: only the bistatic model takes it, got --model {args.model}")
    field = wr.RadioField.fit(
        geometry,
        dataset,
        model=args.model,
        seed=args.seed,
        progress=bars,
        device=args.device,
        **_iterations(args),
        **ruled,
    )
    field.save(args.out)
    print(f"{args.out}: {args.model} fitted on {len(dataset.receivers)} receivers")


def _relevance(args: argparse.Namespace, bars: Bars) -> None:
    source = _existing(args.source)
    given = {"transmitter": args.transmitter, "frequency_hz": args.frequency}
    receivers = None if args.receivers is None else _read_receivers(args.receivers)
    if args.spectra is not None:
        dataset = wr.SpectrumDataset.load(_existing(args.spectra))
        measured = {"transmitter": dataset.transmitter, "frequency_hz": float(dataset.frequency_hz)}
        given = {name: measured[name] if value is None else value for name, value in given.items()}
        receivers = dataset.receivers if receivers is None else receivers
    if receivers is None:
        raise ValueError(
            "--receivers: none given, expected positions, or --spectra with a file that holds some"
        )
    if len(receivers) > args.most:
        receivers = receivers[np.random.default_rng(args.seed).permutation(len(receivers))[: args.most]]
    fitted = source.suffix == ".safetensors"
    found = wr.relevance(
        wr.RadioField.load(source) if fitted else _load_geometry(args.source, args.mesh),
        receivers=receivers,
        tolerance_db=args.tolerance,
        progress=bars,
        device=args.device,
        **given,
    )
    bars.close()
    print(found.table())
    if args.out:
        found.save(args.out)
        text = found.table() + "\n"
        write_atomically(Path(args.out).with_suffix(".md"), lambda name: Path(name).write_text(text))


def _render(args: argparse.Namespace, bars: Bars) -> None:
    source = _existing(args.source)
    if source.suffix == ".safetensors":
        if args.receiver is None:
            raise ValueError("--receiver: none given, expected three coordinates in metres for a radio field")
        spectrum = wr.RadioField.load(source).spectrum(np.array(args.receiver, dtype=np.float64))
        _write_spectrum(spectrum, Path(args.out))
        total = 10.0 * np.log10(max(float(np.sum(spectrum.path_gain, dtype=np.float64)), 1e-300))
        print(f"{args.out}: total path gain {total:.2f} dB at {' '.join(f'{x:g}' for x in args.receiver)}")
        return
    if args.position is None or args.look_at is None:
        raise ValueError(
            "--position and --look-at: both are needed to draw Gaussians (three coordinates each)"
        )
    gaussians = wr.Gaussians.load_ply(source)
    camera = _look_at(args.position, args.look_at, tuple(args.size), args.field_of_view)
    image = wr.render(gaussians, camera, device=args.device).features
    from PIL import Image

    pixels = np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    write_atomically(Path(args.out), lambda path: Image.fromarray(pixels).save(path))
    print(f"{args.out}: {args.size[0]} x {args.size[1]} pixels, {len(gaussians.means)} Gaussians")


def _map(args: argparse.Namespace, bars: Bars) -> None:
    path = Path(args.out)
    if path.suffix not in (".nc", ".png"):
        raise ValueError(f"{path}: expected .nc (NetCDF, a picture beside it) or .png (the picture alone)")
    field = wr.RadioField.load(_existing(args.field), device=args.device)
    found = field.radio_map(
        args.height,
        args.cell,
        transmitter=args.transmitter,
        bounds=args.bounds,
        beam_sigma_rad=np.deg2rad(args.beam_sigma_deg),
        transmit_power_dbm=args.power_dbm,
        bandwidth_hz=args.bandwidth,
        noise_figure_db=args.noise_figure,
        mirror_order=args.mirror_order,
        progress=bars,
    )
    bars.close()
    if path.suffix == ".nc":
        found.save(path)
    found.picture(path.with_suffix(".png"))
    gain, snr = (found.shown(name)[found.free] for name in ("total_path_gain", "best_beam_snr_db"))
    print(
        f"{path}: {found.free.sum()} cells in the air of {found.free.size}; median total path gain "
        f"{np.median(gain):.1f} dB, median SNR of the best beam {np.median(snr):.1f} dB, lowest {snr.min():.1f} dB"
    )


def _evaluate(args: argparse.Namespace, bars: Bars) -> None:
    from warprrf.rf import lookups, metrics

    field = wr.RadioField.load(_existing(args.field))
    dataset = wr.SpectrumDataset.load(_existing(args.spectra))
    train, test = dataset.split(args.train, seed=args.seed)
    methods: dict[str, Any] = {field.model: field.spectrum}
    if args.lookups:
        known = (lookups.nearest, lookups.idw, lookups.constant, lookups.mean)
        methods |= {lookup.name: lookup for lookup in (build(train) for build in known)}
    figures: dict[str, dict[str, Any]] = {}
    for count, (name, predictor) in enumerate(methods.items()):
        bars("evaluate", count, len(methods))
        figures[name] = metrics.evaluate(test, predictor)
    bars("evaluate", len(methods), len(methods))
    bars.close()
    print(table(figures))
    if args.out:
        write_json(args.out, figures)


def _twin(args: argparse.Namespace, bars: Bars) -> None:
    twin = wr.write_twin(wr.RadioField.load(_existing(args.field)), args.out)
    rows = [["surface", "area m2", "permittivity", "S", "lobe", "lobe error dB"]]
    for group in twin.groups:
        rows.append(
            [
                group.name,
                f"{group.area_m2:.1f}",
                f"{group.permittivity.real:.3g}",
                f"{group.scattering:.3f}",
                f"{group.alpha_r}" if group.alpha_r else "Lambertian",
                f"{group.lobe_error_db:.2f}",
            ]
        )
    print(_aligned(rows))
    print(
        f"\n{twin.xml}: {len(twin.groups)} materials; rms errors of the projection over area: scattered power "
        f"{twin.scattering_error_db:.2f} dB, mirrored power {twin.mirror_error_db:.2f} dB, lobes "
        f"{twin.lobe_error_db:.2f} dB"
    )
    for line in twin.left_out:
        print(f"left out: {line}")


def table(methods: dict[str, dict[str, Any]]) -> str:
    """The figures of several methods as aligned text, one row a method."""
    columns = {
        "psnr_db": "PSNR dB",
        "ssim": "SSIM",
        "rmse_db": "RMSE dB",
        "direction_median_deg": "direction deg",
        "direction_within_3deg": "within 3 deg",
        "direction_within_3deg_blocked": "blocked",
        "beam_gain_loss_db": "beam loss dB",
        "tof_error_median_ns": "ToF ns",
        "aod_error_median_deg": "AoD deg",
    }
    shown = [key for key in columns if any(figures.get(key) is not None for figures in methods.values())]
    rows = [["method", *(columns[key] for key in shown)]]
    for name, figures in methods.items():
        cells = [figures.get(key) for key in shown]
        rows.append(
            [
                name,
                *("-" if cell is None else f"{cell:.3g}" if cell < 10 else f"{cell:.2f}" for cell in cells),
            ]
        )
    return _aligned(rows)


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of text with their columns flush right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
    )


# ------------------------------------------------------------------------------------------------ files and poses


def _existing(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder")
    return path


def _read_positions(path: str | os.PathLike[str]) -> dict[str, tuple[float, float, float]]:
    """`{file: (x, y, z)}` from JSON of that form or CSV rows `file,x,y,z`; metres."""
    path = _existing(path)
    try:
        if path.suffix == ".json":
            content = json.loads(path.read_text())
            rows = [(name, *position) for name, position in content.items()]
        else:
            with path.open(newline="") as lines:
                rows = [tuple(row) for row in csv.reader(lines) if row and not row[0].startswith("#")]
            if rows and rows[0][0] == "file":
                rows = rows[1:]
        return {str(name): (float(x), float(y), float(z)) for name, x, y, z in rows}
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(
            f'{path}: expected camera positions in metres, JSON {{"file.jpg": [x, y, z]}} or CSV file,x,y,z ({error})'
        ) from error


def _read_receivers(values: Sequence[str]) -> np.ndarray:
    """(R, 3) positions in metres from a CSV or NPY file, or from `x,y,z` words."""
    if len(values) == 1 and "," not in values[0]:
        path = _existing(values[0])
        try:
            if path.suffix == ".npy":
                found = np.load(path, allow_pickle=False)
            else:
                found = np.loadtxt(path, delimiter=",", ndmin=2, comments=("#", "x"))
        except ValueError as error:
            raise ValueError(f"{path}: expected rows x,y,z in metres ({error})") from error
        if found.ndim != 2 or found.shape[1] != 3:
            raise ValueError(f"{path}: got shape {found.shape}, expected (R, 3): rows x,y,z in metres")
        return np.asarray(found, dtype=np.float64)
    rows = [word.split(",") for word in values]
    for word, row in zip(values, rows, strict=True):
        if len(row) != 3:
            raise ValueError(f"--receivers: got {word!r}, expected x,y,z in metres or one CSV/NPY file")
    try:
        return np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise ValueError(
            f"--receivers: got {' '.join(values)!r}, expected numbers x,y,z in metres"
        ) from error


def _load_geometry(path: str, mesh: str | None) -> Any:
    """A saved reconstruction (folder), splats (PLY, optionally with a mesh), or a scene (XML: its true mesh)."""
    source = _existing(path)
    if source.is_dir():
        return wr.Reconstruction.load(source)
    if source.suffix == ".xml":
        return wr.Scene.load(source)
    if source.suffix == ".ply":
        return wr.Reconstruction.from_files(source, mesh=_existing(mesh) if mesh else None)
    raise ValueError(f"{source}: expected a reconstruction's folder, splats (.ply) or a scene (.xml)")


def _write_spectrum(spectrum: Any, path: Path) -> None:
    if path.suffix == ".npz":
        arrays = {"path_gain": spectrum.path_gain, "delay_s": spectrum.delay_s, "aod": spectrum.aod}
        write_atomically(path, lambda name: np.savez_compressed(name, **arrays))
    elif path.suffix == ".png":
        figure = require("matplotlib.figure", extra="plots").Figure(figsize=(8.0, 4.2), layout="constrained")
        spectrum.plot(ax=figure.add_subplot())
        write_atomically(path, lambda name: figure.savefig(name, dpi=130))
    else:
        raise ValueError(f"{path}: expected .png (a picture) or .npz (path_gain, delay_s, aod)")


def _look_at(
    position: Sequence[float], target: Sequence[float], size: tuple[int, int], fov_deg: float
) -> Any:
    """A pinhole camera at `position` that looks at `target`, z up; `fov_deg` is horizontal."""
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


def _iterations(args: argparse.Namespace) -> dict[str, Any]:
    return {} if args.iterations is None else {"iterations": args.iterations}


# ------------------------------------------------------------------------------------------------------ arguments


def _parser() -> argparse.ArgumentParser:
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--seed", type=int, default=0, help="every random choice follows from it (default 0)")
    common.add_argument("--device", default=None, help="cpu or cuda:0 (default: the GPU where there is one)")
    common.add_argument("--quiet", action="store_true", help="no progress bars")
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")

    parser = argparse.ArgumentParser(
        prog="warprrf",
        description="Radio radiance fields from photos and a few radio measurements.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"warprrf {wr.__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(
        name: str, run: Callable[..., None], line: str, text: str, to: Any = commands, options: bool = True
    ) -> argparse.ArgumentParser:
        one: argparse.ArgumentParser = to.add_parser(
            name,
            help=line,
            description=f"{line[0].upper()}{line[1:]}.",
            epilog=text,
            parents=[common] if options else [],
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        one.set_defaults(command=run)
        return one

    lobby = add("lobby", _lobby, "the main job: photos -> geometry -> radio -> evaluation", HELP_LOBBY)
    lobby.add_argument("--out", default="runs/lobby", help="folder of the results (default runs/lobby)")
    lobby.add_argument("--data", default="data/lobby", help="the lobby's photos, scene and spectra")
    lobby.add_argument(
        "--reduced", action="store_true", help="few photos and steps: shows that it runs, in minutes"
    )
    lobby.add_argument("--fresh", action="store_true", help="start over instead of continuing")

    rec = add(
        "reconstruct", _reconstruct, "photos -> cameras, Gaussians, mesh and planar patches", HELP_RECONSTRUCT
    )
    rec.add_argument("photos", help="folder of JPEG or PNG photos of one static room")
    rec.add_argument("-o", "--out", required=True, help="folder of the result")
    rec.add_argument(
        "--known-positions", metavar="FILE", help="surveyed camera positions, JSON or CSV: sets metres"
    )
    rec.add_argument("--workspace", help="where unfinished work lives (default OUT/workspace)")

    sim = add("simulate", _simulate, "radio spectra of a scene at given receivers", HELP_SIMULATE)
    sim.add_argument("scene", help="scene XML (Mitsuba/Sionna RT), with materials.json beside it")
    sim.add_argument("-o", "--out", required=True, help="NetCDF file")
    sim.add_argument(
        "--transmitter", nargs=3, type=float, required=True, metavar=("X", "Y", "Z"), help="metres"
    )
    sim.add_argument(
        "--receivers", nargs="+", required=True, help="CSV or NPY file of x,y,z rows, or x,y,z words"
    )
    sim.add_argument("--frequency", type=float, default=300e9, metavar="HZ", help="carrier (default 300e9)")
    sim.add_argument(
        "--shape", nargs=2, type=int, default=(90, 180), metavar=("H", "W"), help="pixels (90 180)"
    )
    sim.add_argument("--engine", choices=("exact", "sionna"), default="exact", help="default exact")
    sim.add_argument(
        "--depth", type=int, default=3, help="most interactions (sionna; exact has one; default 3)"
    )
    sim.add_argument(
        "--samples", type=int, default=1_000_000, help="rays per transmitter (sionna; default 1e6)"
    )
    sim.add_argument("--beam-sigma-deg", type=float, default=2.0, help="receiver beam (default 2 degrees)")
    sim.add_argument("--refraction", action="store_true", help="transmission through walls (sionna)")
    sim.add_argument("--gas", action="store_true", help="absorption by standard air (ITU-R P.676)")

    fit = add("fit", _fit, "a radio field from geometry and measured spectra", HELP_FIT)
    fit.add_argument("geometry", help="a reconstruction's folder, splats (.ply) or a scene (.xml)")
    fit.add_argument("spectra", help="NetCDF file of spectra")
    fit.add_argument("-o", "--out", required=True, help="field file (.safetensors)")
    fit.add_argument(
        "--model", choices=("bistatic", "rf3dgs+", "rf3dgs"), default="bistatic", help="default bistatic"
    )
    fit.add_argument(
        "--train", type=int, metavar="N", help="receivers of the nested training subset (default: all)"
    )
    fit.add_argument("--mesh", help="mesh for line of sight, where GEOMETRY is a .ply")
    fit.add_argument(
        "--relevance", metavar="FILE", help="what `warprrf relevance -o` wrote: terms ruled out are off"
    )
    fit.add_argument("--iterations", type=int, help="optimiser steps (default: the model's)")

    rel = add(
        "relevance",
        _relevance,
        "what each effect is worth in a scene, and the smallest model",
        HELP_RELEVANCE,
    )
    rel.add_argument(
        "source", help="scene (.xml), reconstruction's folder, splats (.ply) or field (.safetensors)"
    )
    rel.add_argument("-o", "--out", help="JSON file; the table goes beside it as Markdown")
    rel.add_argument("--spectra", help="NetCDF file whose transmitter, carrier and receivers are used")
    rel.add_argument("--transmitter", nargs=3, type=float, metavar=("X", "Y", "Z"), help="metres")
    rel.add_argument("--receivers", nargs="+", help="CSV or NPY file of x,y,z rows, or x,y,z words")
    rel.add_argument("--frequency", type=float, metavar="HZ", help="carrier (a field's own)")
    rel.add_argument("--tolerance", type=float, default=0.1, metavar="DB", help="default 0.1")
    rel.add_argument(
        "--most", type=int, default=12, metavar="N", help="receivers used, drawn by --seed (default 12)"
    )
    rel.add_argument("--mesh", help="mesh for line of sight, where SOURCE is a .ply")

    ren = add("render", _render, "a picture from Gaussians, or a spectrum from a radio field", HELP_RENDER)
    ren.add_argument("source", help="Gaussians (.ply) or a radio field (.safetensors)")
    ren.add_argument("-o", "--out", required=True, help="picture (.png), or for a spectrum also .npz")
    ren.add_argument(
        "--receiver", nargs=3, type=float, metavar=("X", "Y", "Z"), help="where the spectrum is taken"
    )
    ren.add_argument(
        "--position", nargs=3, type=float, metavar=("X", "Y", "Z"), help="where the camera stands"
    )
    ren.add_argument("--look-at", nargs=3, type=float, metavar=("X", "Y", "Z"), help="a point it looks at")
    ren.add_argument(
        "--size", nargs=2, type=int, default=(640, 480), metavar=("W", "H"), help="pixels (640 480)"
    )
    ren.add_argument("--field-of-view", type=float, default=75.0, help="horizontal, degrees (default 75)")

    eva = add("evaluate", _evaluate, "a field's errors on receivers it was not fitted on", HELP_EVALUATE)
    eva.add_argument("field", help="field file (.safetensors)")
    eva.add_argument("spectra", help="NetCDF file of spectra with held-out receivers")
    eva.add_argument(
        "--train", type=int, default=50, metavar="N", help="what the lookups may see (default 50)"
    )
    eva.add_argument("--no-lookups", dest="lookups", action="store_false", help="the field alone")
    eva.add_argument("-o", "--out", help="JSON file of the figures")

    plan = add("map", _map, "a field's radio map over the floor plan", HELP_MAP)
    plan.add_argument("field", help="field file (.safetensors)")
    plan.add_argument("-o", "--out", required=True, help="NetCDF file (.nc), or the picture alone (.png)")
    plan.add_argument("--height", type=float, default=1.5, metavar="M", help="of receivers (default 1.5)")
    plan.add_argument("--cell", type=float, default=0.25, metavar="M", help="width of a cell (default 0.25)")
    plan.add_argument(
        "--transmitter", nargs=3, type=float, metavar=("X", "Y", "Z"), help="if another than the fitted one"
    )
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

    twin = add("twin", _twin, "a field's digital twin: a scene for Sionna RT", HELP_TWIN)
    twin.add_argument("field", help="field file (.safetensors) of model bistatic")
    twin.add_argument(
        "-o", "--out", required=True, help="folder of the twin: new, empty or an earlier twin's"
    )

    add_benches(add)

    data = add("data", _data, "regenerate data/lobby/ from nothing (hours; resumable)", HELP_DATA)
    data.add_argument("--data", default="data/lobby", help="folder to write (default data/lobby)")
    data.add_argument("--only", nargs="+", choices=("scene", "photos", "spectra"), help="these steps alone")
    data.add_argument(
        "--full",
        action="store_true",
        help="all 800 receivers too (spectra_full.nc and spectra_sionna_full.nc)",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
