"""What the commands are given: files that exist, positions, receivers, geometry."""

from __future__ import annotations

import argparse
import csv
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from warprrf.checks import check_array
from warprrf.files import read_json
from warprrf.geometry.mesh_files import METRES, READERS, is_mesh_file
from warprrf.geometry.ply_files import ply_columns
from warprrf.tensor_files import named

Add = Callable[..., argparse.ArgumentParser]
"""Defines one command: name and what runs it, whose docstring is its help (or a line and a text of help)."""


def add_point(parser: argparse.ArgumentParser, flag: str, text: str, required: bool = False) -> None:
    """Define an option of three coordinates [m]."""
    parser.add_argument(flag, nargs=3, type=float, metavar=("X", "Y", "Z"), help=text, required=required)


def add_out(parser: argparse.ArgumentParser, text: str, required: bool = True) -> None:
    """Define the option that says where the result goes; an empty name is refused before any work is done."""
    parser.add_argument("-o", "--out", required=required, type=_file_name, help=text)


def _file_name(text: str) -> str:
    if not text.strip():
        raise argparse.ArgumentTypeError(f"got {text!r}, expected the name of a file or folder")
    return text


def existing(path: str | os.PathLike[str]) -> Path:
    """``path``, which must exist."""
    path = Path(path)
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder")
    return path


def read_positions(path: str | os.PathLike[str]) -> dict[str, tuple[float, float, float]]:
    """`{file: (x, y, z)}` from JSON of that form or CSV rows `file,x,y,z`; metres."""
    path = existing(path)
    try:
        if path.suffix == ".json":
            rows = [(name, *position) for name, position in read_json(path).items()]
        else:
            with path.open(newline="", encoding="utf-8-sig") as lines:
                rows = [tuple(row) for row in csv.reader(lines) if row and not row[0].startswith("#")]
            if rows and rows[0][0] == "file":
                rows = rows[1:]
        return {str(name): (float(x), float(y), float(z)) for name, x, y, z in rows}
    except (ValueError, TypeError) as error:
        raise ValueError(
            f'{path}: expected camera positions in metres, JSON {{"file.jpg": [x, y, z]}} or CSV file,x,y,z ({error})'
        ) from error


def add_readings_options(parser: argparse.ArgumentParser) -> None:
    """Define what tables of received power do not say themselves."""
    own = parser.add_argument_group("tables of received power (CSV)")
    own.add_argument("--carrier", type=float, metavar="HZ", help="carrier frequency")
    own.add_argument(
        "--noise-floor-db", type=float, help="readings not above it only say that there was no more"
    )
    own.add_argument("--horn-deg", type=float, help="width of the receiver's horn at half maximum")
    own.add_argument("--tx-horn-deg", type=float, help="width of the transmitter's horn")
    own.add_argument("--bandwidth", type=float, metavar="HZ", help="of the sounder, for delays")


OF_TABLES = ("carrier", "noise_floor_db", "horn_deg", "tx_horn_deg", "bandwidth")


def read_readings(path: Path, args: argparse.Namespace) -> wr.Readings:
    """A table of received power."""
    for flag in ("carrier", "noise_floor_db"):
        if getattr(args, flag) is None:
            raise ValueError(f"--{flag.replace('_', '-')}: {path} needs it, it is a table of received power")
    horns = {
        name: None if width is None else wr.horn(np.radians(width))
        for name, width in (("receive_pattern", args.horn_deg), ("transmit_pattern", args.tx_horn_deg))
    }
    if abs(args.noise_floor_db) > 1000.0:
        raise ValueError(f"--noise-floor-db: got {args.noise_floor_db:g}, expected -1000 to 1000")
    return wr.Readings.load(
        path, frequency_hz=args.carrier, floor=10.0 ** (args.noise_floor_db / 10.0), bandwidth_hz=args.bandwidth,
        name=path.stem, **horns,
    )  # fmt: skip


def read_scale(words: Sequence[str]) -> float | tuple[str, str, float]:
    """Two photos and the distance between their cameras [m], or metres for each unit, from three words or one."""
    try:
        *photos, number = words
        length = float(number)
    except ValueError as error:
        raise ValueError(f"--scale: got {words[-1]!r}, expected a number of metres") from error
    if len(photos) not in (0, 2):
        raise ValueError(f"--scale: got {' '.join(words)!r}, expected two photos and metres, or one number")
    return (photos[0], photos[1], length) if photos else length


def refuse(args: argparse.Namespace, flags: Sequence[str], reason: str) -> None:
    """Raise for options among ``flags`` that were given and would change nothing."""
    for flag in flags:
        if getattr(args, flag) is not None:
            raise ValueError(f"--{flag.replace('_', '-')}: got {getattr(args, flag)!r}, but {reason}")


def read_receivers(values: Sequence[str], name: str = "--receivers") -> np.ndarray:
    """(R, 3) positions in metres from a CSV or NPY file, or from `x,y,z` words."""
    if len(values) == 1 and "," not in values[0]:
        path = existing(values[0])
        with named(path, "expected rows x,y,z in metres"):
            if path.suffix == ".npy":
                found = np.load(path, mmap_mode="r", allow_pickle=False)
            else:
                lines = [re.split("[#x]", line)[0] for line in path.read_text("utf-8-sig").splitlines()]
                lines = [line for line in lines if line.strip()]
                found = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.zeros((0, 3))
            return check_array("rows x,y,z in metres", found, (None, 3))
    try:
        rows = np.array([word.split(",") for word in values], dtype=np.float64)
    except ValueError as error:
        raise ValueError(
            f"{name}: got {' '.join(values)!r}, expected numbers x,y,z in metres or one CSV/NPY file"
        ) from error
    if rows.shape[1] != 3:
        raise ValueError(f"{name}: got {values[0]!r}, expected x,y,z in metres or one CSV/NPY file")
    return rows


def add_mesh_options(parser: argparse.ArgumentParser) -> None:
    """Define how a mesh file is read."""
    parser.add_argument("--unit", choices=tuple(METRES), help="of a mesh file (default m)")
    parser.add_argument(
        "--up",
        choices=("x", "y", "z"),
        help="axis of a mesh file that points up (default: y for glTF, else z)",
    )
    parser.add_argument("--simplify", type=int, metavar="N", help="most triangles of a mesh file")


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """Define what of a scene file's materials is taken, and that it may name any file."""
    parser.add_argument("--materials", metavar="FILE", help="table that replaces a scene's materials by name")
    parser.add_argument(
        "--extrapolate",
        action="store_true",
        help="let a scene's materials hold outside their bands, by the nearest band's law",
    )
    parser.add_argument(
        "--allow-outside",
        action="store_true",
        help="read files outside the folder of a scene or mesh file too",
    )


def load_scene(path: str | Path, options: argparse.Namespace) -> wr.Scene:
    """A scene file that Sionna RT opens, or a mesh file."""
    materials = None if options.materials is None else existing(options.materials)
    return wr.Scene.load(
        existing(path),
        materials=materials,
        extrapolate=options.extrapolate,
        allow_outside=options.allow_outside,
        unit=options.unit,
        up=options.up,
        simplify=options.simplify,
    )


def load_geometry(path: str, mesh: str | None, options: argparse.Namespace) -> Any:
    """A saved reconstruction (folder), splats (PLY, optionally with a mesh), a scene (XML) or a mesh file."""
    source = existing(path)
    if source.is_dir():
        return wr.Reconstruction.load(source)
    if source.suffix == ".xml":
        return load_scene(source, options)
    if not is_mesh_file(source):
        raise ValueError(
            f"{source}: expected a reconstruction's folder, splats (.ply), a scene (.xml) or a mesh "
            f"({', '.join(READERS)})"
        )
    if source.suffix.lower() == ".ply" and "scale_0" in ply_columns(source).get("vertex", ()):
        own = None if mesh is None else _load_mesh(mesh, options)
        return wr.Reconstruction.from_files(source, mesh=own)
    if mesh is not None:
        raise ValueError(f"--mesh: {source} is a mesh itself, expected splats (.ply) where --mesh is given")
    return _load_mesh(source, options)


def _load_mesh(path: str | Path, options: argparse.Namespace) -> wr.Mesh:
    return wr.Mesh.load(
        existing(path),
        options.unit,
        options.up,
        simplify=options.simplify,
        allow_outside=options.allow_outside,
    )
