"""What the commands are given: files that exist, positions, receivers, geometry."""

from __future__ import annotations

import argparse
import csv
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

import warprrf as wr
from warprrf.checks import check_array
from warprrf.files import read_json
from warprrf.geometry.mesh_files import METRES, READERS, is_mesh_file
from warprrf.geometry.ply_files import holds_gaussians
from warprrf.rf.tracing.model import SETS
from warprrf.tensor_files import named

Add = Callable[..., argparse.ArgumentParser]
"""Defines one command: name and what runs it, whose docstring is its help (or a line and a text of help)."""


def add_point(parser: argparse.ArgumentParser, flag: str, text: str, required: bool = False) -> None:
    """Define an option of three coordinates [m]."""
    parser.add_argument(flag, nargs=3, type=float, metavar=("X", "Y", "Z"), help=text, required=required)


def add_out(parser: argparse.ArgumentParser, text: str, required: bool = True) -> None:
    """Define the option that says where the result goes: a file, or, as the ``text`` then begins, a folder. Another name is
    refused before any work is done."""
    kind = "folder" if text.startswith("folder") else "file"

    def name(given: str) -> str:
        if not given.strip() or (kind == "file" and os.path.isdir(given)):
            raise argparse.ArgumentTypeError(f"got {given!r}, expected the name of a {kind}")
        above = next(p for p in Path(given).absolute().parents if os.path.exists(p))  # the rest is made
        if not (above.is_dir() and os.access(above, os.W_OK)):
            raise argparse.ArgumentTypeError(
                f"got {given!r}, but {above} is no folder that may be written to"
            )
        return given

    parser.add_argument("-o", "--out", required=required, type=name, help=text)


def beside(out: str, suffix: str) -> Path:
    """The file that a command writes beside ``out``; what stands there without ``out`` is no earlier run's, and stays."""
    path = Path(out).with_suffix(suffix)
    if path.exists() and not os.path.exists(out):
        raise ValueError(
            f"--out: got {out!r}, beside which {path} would be written over; expected another name"
        )
    return path


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
        if path.suffix.lower() == ".json":
            rows = [(name, *position) for name, position in read_json(path).items()]
        else:
            with path.open(newline="", encoding="utf-8-sig") as lines:
                rows = [tuple(row) for row in csv.reader(lines) if row and not row[0].startswith("#")]
            if rows and [cell.strip() for cell in rows[0]] == ["file", "x", "y", "z"]:
                rows = rows[1:]
        found = {str(name): (float(x), float(y), float(z)) for name, x, y, z in rows}
        if len(found) < len(rows):
            raise ValueError("a file stands in it twice")
        return found
    except (ValueError, TypeError) as error:
        raise ValueError(
            f'{path}: expected camera positions in metres, JSON {{"file.jpg": [x, y, z]}} or CSV file,x,y,z ({error})'
        ) from error


class Parser(argparse.ArgumentParser):
    """Words that it cannot take are bad input as any other: one line, or JSON."""

    def error(self, message: str) -> NoReturn:
        """Raise ValueError."""
        raise ValueError(f"{message} (see {self.prog} --help)")


def add_frequency(parser: Any, text: str, **options: Any) -> None:
    """Define the option of the carrier frequency, of one name wherever there is one."""
    parser.add_argument("--frequency", type=float, metavar="HZ", help=text, **options)


def add_pattern(parser: Any, flag: str, text: str) -> None:
    """Define the option of an antenna's pattern."""
    parser.add_argument(
        flag, metavar="PATTERN",
        help=f"{text}: a horn's width at half maximum in degrees, with its side lobes' level in dB where known (10 or "
        "10,-25), a file of linear gains from 0 to 180 degrees, an MSI Planet file (.msi, .pln), or isotropic",
    )  # fmt: skip


def add_measured_options(parser: Any) -> None:
    """Define what files of measurements do not say themselves."""
    own = parser.add_argument_group(
        "measurements", "for all files, or NAME=VALUE behind a file for that one: horn.csv receive-pattern=10"
    )
    add_frequency(own, "carrier of tables (CSV) and of arrays (folders)")
    own.add_argument(
        "--noise-floor-db", type=float, help="readings not above it only say that there was no more"
    )
    add_pattern(own, "--receive-pattern", "of the receiver's antenna, where a table tells its direction")
    add_pattern(own, "--transmit-pattern", "of the transmitter's antenna")
    own.add_argument(
        "--samples", type=int, metavar="N", help="of fading in a reading's mean: 1 for one place"
    )
    own.add_argument("--bandwidth", type=float, metavar="HZ", help="of the sounder, for delays")
    own.add_argument("--window", choices=("rectangular", "hann"), help="of the sounder (default rectangular)")
    own.add_argument(
        "--azimuth", choices=("known", "unknown"), help="whether azimuths count from a known zero"
    )
    own.add_argument("--clock", choices=("known", "unknown"), help="whether delays count from a known zero")
    own.add_argument("--position-std", type=float, metavar="M", help="how far off receivers may have stood")
    own.add_argument("--length-std", type=float, metavar="M", help="how well an array's mesh knows lengths")
    own.add_argument("--name", help="by which the report tells the readings (default the file's)")


OF_TABLES = {
    "frequency": "frequency_hz", "receive_pattern": "receive_pattern", "transmit_pattern": "transmit_pattern",
    "samples": "samples", "bandwidth": "bandwidth_hz", "window": "window", "position_std": "position_std_m", "name": "name",
}  # fmt: skip
OF_ARRAYS = {"frequency": "frequency_hz", "length_std": "length_std_m", "name": "name"}
TAKEN = {
    "table": (*OF_TABLES, "noise_floor_db", "azimuth", "clock"), "array": tuple(OF_ARRAYS), "spectra": ("train",), "thing": (),
}  # fmt: skip
"""Options by the kind of file that they say something of, and what the library calls those that are passed on."""


def read_measured(
    words: Sequence[str], args: argparse.Namespace, others: bool = False, frequency_hz: float | None = None
) -> list[Any]:
    """What files hold: spectra (NetCDF, or NPZ of the arguments of ``from_spectra``), readings (CSV), spectra of arrays
    (a folder as NeRF2 has it); behind each file its own settings. With ``others`` the names of other files stay.
    ``frequency_hz`` is the carrier where none is given."""
    files: list[tuple[str, list[str]]] = []
    for word in words:
        if "=" in word and files and not Path(word).exists():
            files[-1][1].append(f"--{word}")
        else:
            files.append((word, []))
    parser = Parser(prog=" ".join(["warprrf", *sys.argv[1:2]]), add_help=False, allow_abbrev=False)
    add_measured_options(parser)
    kinds = [_kind(existing(path), others) for path, _ in files]
    known = vars(parser.parse_args([]))
    flags = [flag.replace("_", "-") for flag in known]
    for path, settings in files:
        for setting in settings:
            if setting[2:].partition("=")[0] not in flags:
                raise ValueError(
                    f"{path}: got {setting[2:]!r} behind it, expected NAME=VALUE, NAME among {', '.join(flags)}"
                )
    names = {*known, "train"}.difference(*(TAKEN[kind] for kind in kinds))
    refuse(args, sorted(names), "no file is given that it could be of")
    if args.frequency is None:
        args.frequency = frequency_hz
    own = [parser.parse_args(settings) for _, settings in files]
    found = []
    for kind, (path, _), said in zip(kinds, files, own, strict=True):
        refuse(
            said, [n for n in vars(said) if n not in TAKEN[kind]], f"{path} is no file that it could be of"
        )
        for name, value in vars(said).items():
            setattr(said, name, getattr(args, name) if value is None else value)
        said.train, said.seed = getattr(args, "train", None), args.seed
        found.append(_READ[kind](Path(path), said))
    return found


def _kind(path: Path, others: bool) -> str:
    if path.suffix.lower() == ".csv":
        return "table"
    if path.is_dir() and (path / "tx_pos.csv").exists():
        return "array"
    return "thing" if others else "spectra"


def _table(path: Path, args: argparse.Namespace) -> wr.Readings:
    for flag in ("frequency", "noise_floor_db"):
        if getattr(args, flag) is None:
            raise ValueError(f"--{flag.replace('_', '-')}: {path} needs it, it is a table of received power")
    if abs(args.noise_floor_db) > 1000.0:
        raise ValueError(f"--noise-floor-db: got {args.noise_floor_db:g}, expected -1000 to 1000")
    settings = {"name": path.stem} | _passed_on(args, OF_TABLES)
    settings |= {name: read_pattern(text) for name, text in settings.items() if name.endswith("pattern")}
    floor = 10.0 ** (args.noise_floor_db / 10.0)
    zeros = {"azimuth_known": args.azimuth != "unknown", "clock_known": args.clock != "unknown"}
    return wr.Readings.load(path, floor=floor, **zeros, **settings)


def _array(path: Path, args: argparse.Namespace) -> wr.channel.ArraySpectra:
    if args.frequency is None:
        raise ValueError(f"--frequency: {path} needs it, it is a folder of an array's spectra")
    settings = {"name": path.name} | _passed_on(args, OF_ARRAYS)
    part = "train" if (path / "train_index.txt").exists() else None
    return wr.channel.ArraySpectra.load(path, part=part, **settings)


def _passed_on(args: argparse.Namespace, names: Mapping[str, str]) -> dict[str, Any]:
    return {name: getattr(args, flag) for flag, name in names.items() if getattr(args, flag) is not None}


def _training(path: Path, args: argparse.Namespace) -> wr.SpectrumDataset:
    """Its training receivers; all where none are said to be for training."""
    dataset = load_spectra(path)
    if args.train is not None:
        return dataset.split(args.train, seed=args.seed)[0]
    training = dataset.role == "train"
    return dataset.subset(training) if training.any() else dataset


_READ: dict[str, Callable[[Path, argparse.Namespace], Any]] = {
    "table": _table, "array": _array, "spectra": _training, "thing": lambda path, args: path,
}  # fmt: skip


def load_spectra(path: str | Path) -> wr.SpectrumDataset:
    """A NetCDF file of spectra, or arrays (.npz) under the names of the arguments of ``SpectrumDataset.from_spectra``."""
    file = existing(path)
    if file.suffix.lower() != ".npz":
        return wr.SpectrumDataset.load(file)
    with named(file, "expected arrays named as the arguments of SpectrumDataset.from_spectra"):
        with np.load(file, allow_pickle=False) as arrays:
            given: dict[str, Any] = {
                name: array if array.ndim else array.item() for name, array in arrays.items()
            }
        return wr.SpectrumDataset.from_spectra(**given)


def load_field(path: str | Path, args: argparse.Namespace) -> wr.RadioField:
    """A field's file, at the carrier that is asked for."""
    field = wr.RadioField.load(existing(path), device=args.device)
    if args.frequency is None:
        return field
    if field.model != "bistatic":
        raise ValueError(f"--frequency: {path} is of model {field.model}, which knows its own carrier alone")
    return field.at_frequency(args.frequency)  # type: ignore[attr-defined]


def read_pattern(text: str) -> Any:
    """The gain of a horn of ``WIDTH`` degrees, or ``WIDTH,LEVEL`` with side lobes in dB; of a file; or of no antenna."""
    if text == "isotropic":
        return np.ones(2)
    try:
        width, *level = (float(word) for word in text.split(","))
    except ValueError:
        if text.lower().endswith((".msi", ".pln")):
            return wr.Antenna.load(text)
        return read_rows(existing(text), "gains from 0 to 180 degrees, a number a row", 1)[:, 0]
    if len(level) > 1:
        raise ValueError(f"pattern: got {text!r}, expected WIDTH or WIDTH,LEVEL in degrees and dB")
    return wr.horn(np.radians(width), *level)


def add_effects(parser: argparse.ArgumentParser, text: str) -> None:
    """Define the option that says which paths are modelled."""
    parser.add_argument(
        "--effects", metavar="NAME",
        help=f"{text}: {', '.join(SETS)}; or fields of wr.Effects in JSON, such as {{\"mirrors\": 2, \"residual\": false}}: "
        "all others are on",
    )  # fmt: skip


def read_effects(text: str) -> Any:
    """Effects by a mapping of fields in JSON, or the name of a set as it is."""
    value = read_json_or_text(text)
    if not isinstance(value, dict):
        return value
    known = [f.name for f in fields(wr.Effects)]
    unknown = sorted(set(value) - set(known))
    if unknown:
        raise ValueError(f"--effects: got {', '.join(unknown)}, expected among {', '.join(known)}")
    return wr.Effects(**value)


def read_json_or_text(text: str) -> Any:
    """What is written in JSON, or else the text; lists as tuples."""
    try:
        found = json.loads(text)
    except ValueError:
        found = text
    return tuple(found) if isinstance(found, list) else found


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
        if getattr(args, flag, None) is not None:
            raise ValueError(f"--{flag.replace('_', '-')}: got {getattr(args, flag)!r}, but {reason}")


def read_rows(path: Path, what: str, columns: int, names: str = "") -> np.ndarray:
    """Rows of ``columns`` numbers of a CSV or NPY file; a line of their ``names`` and comments are left out."""
    with named(path, f"expected {what}"):
        if path.suffix.lower() == ".npy":
            found = np.load(path, mmap_mode="r", allow_pickle=False)
        else:
            lines = [line.split("#")[0].strip() for line in path.read_text("utf-8-sig").splitlines()]
            lines = [line for line in lines if line and line.replace(" ", "") != names]
            found = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.zeros((0, columns))
        return check_array(what, found, (None, columns))


PLACES = "x,y,z in metres"
POINTINGS = "x,y,z,azimuth,elevation in metres and degrees"  # that a horn is turned to


def read_receivers(values: Sequence[str], name: str = "--receivers", what: str = PLACES) -> np.ndarray:
    """(R, 3) positions, or (R, 5) of :data:`POINTINGS`, from a CSV or NPY file or from `x,y,z` words."""
    count = what.count(",") + 1
    if len(values) == 1 and "," not in values[0]:
        return read_rows(existing(values[0]), f"rows {what}", count, what.split()[0])
    rows = []
    for word in values:
        try:
            rows.append([float(number) for number in word.split(",")])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != count:
            raise ValueError(f"{name}: got {word!r}, expected numbers {what}, or one CSV/NPY file")
    return np.array(rows)


OF_GEOMETRY = ("mesh", "unit", "up", "simplify", "materials", "extrapolate", "allow_outside")
"""Options that say how a scene or mesh file is read."""


def add_geometry_options(parser: argparse.ArgumentParser, splats: str = "") -> None:
    """Define how a mesh file is read, what of a scene file's materials is taken, and that either may name any file; and a
    mesh beside splats, where the argument ``splats`` may be some."""
    if splats:
        parser.add_argument("--mesh", help=f"mesh for line of sight, where {splats} is splats")
    parser.add_argument("--unit", choices=tuple(METRES), help="of a mesh file (default m)")
    parser.add_argument(
        "--up",
        choices=("x", "y", "z"),
        help="axis of a mesh file that points up (default: y for glTF, else z)",
    )
    parser.add_argument("--simplify", type=int, metavar="N", help="most triangles of a mesh file")

    parser.add_argument("--materials", metavar="FILE", help="table that replaces a scene's materials by name")
    parser.add_argument(
        "--extrapolate",
        action="store_const",
        const=True,
        help="let a scene's materials hold outside their bands, by the nearest band's law",
    )
    parser.add_argument(
        "--allow-outside",
        action="store_const",
        const=True,
        help="read files outside the folder of a scene or mesh file too",
    )


def load_scene(path: str | Path, options: argparse.Namespace) -> wr.Scene:
    """A scene file that Sionna RT opens, or a mesh file."""
    materials = None if options.materials is None else existing(options.materials)
    how = _mesh_options(options) | {"extrapolate": bool(options.extrapolate)}
    return wr.Scene.load(existing(path), materials=materials, **how)


def load_geometry(path: str, options: argparse.Namespace) -> Any:
    """A saved reconstruction (folder), splats (PLY, optionally with a mesh), a scene (XML) or a mesh file, which is a scene
    where materials are given."""
    source, mesh = existing(path), options.mesh
    splats = holds_gaussians(source)
    if options.materials is not None and (source.is_dir() or splats):
        raise ValueError(f"--materials: {source} names no materials, expected a scene (.xml) or a mesh file")
    if source.is_dir():
        refuse(options, OF_GEOMETRY, f"{source} is a reconstruction, which has its own mesh")
        return wr.Reconstruction.load(source)
    if splats:
        if mesh is None:
            refuse(options, OF_GEOMETRY, f"{source} holds splats, and no --mesh is given")
        refuse(options, ["extrapolate"], f"{source} names no materials")
        return wr.Reconstruction.from_files(source, mesh=None if mesh is None else _load_mesh(mesh, options))
    if mesh is not None:
        raise ValueError(f"--mesh: {source} has surfaces itself, expected splats (.ply) with --mesh")
    if source.suffix.lower() == ".xml" or options.materials is not None:
        return load_scene(source, options)
    if not is_mesh_file(source):
        raise ValueError(
            f"{source}: expected a reconstruction's folder, splats (.ply), a scene (.xml) or a mesh "
            f"({', '.join(READERS)})"
        )
    refuse(options, ["extrapolate"], f"{source} is read without --materials")
    return _load_mesh(source, options)


def _load_mesh(path: str | Path, options: argparse.Namespace) -> wr.Mesh:
    return wr.Mesh.load(existing(path), **_mesh_options(options))


def _mesh_options(options: argparse.Namespace) -> dict[str, Any]:
    how = {name: getattr(options, name) for name in ("unit", "up", "simplify")}
    return how | {"allow_outside": bool(options.allow_outside)}
