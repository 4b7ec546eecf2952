"""The main job's steps, one at a time: `warprrf reconstruct`, `simulate`, `fit`, `evaluate`, and `relevance`."""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from warprrf.checks import check_count
from warprrf.cli.inputs import (
    OF_GEOMETRY,
    POINTINGS,
    Add,
    add_effects,
    add_frequency,
    add_geometry_options,
    add_measured_options,
    add_out,
    add_pattern,
    add_point,
    beside,
    existing,
    load_field,
    load_geometry,
    load_scene,
    load_spectra,
    read_effects,
    read_json_or_text,
    read_measured,
    read_pattern,
    read_positions,
    read_receivers,
    read_scale,
    refuse,
)
from warprrf.cli.output import Output, table
from warprrf.files import plain, write_json, write_text
from warprrf.geometry.photos.config import LENSES, ReconstructionConfig
from warprrf.rf.tracing.model import SETS
from warprrf.steps import RECORDS


def add_reconstruct(add: Add) -> None:
    """Define `reconstruct`."""
    rec = add("reconstruct", _reconstruct)
    rec.add_argument("photos", help="folder of JPEG or PNG photos of one static room")
    add_out(rec, "folder of the result")
    rec.add_argument(
        "--known-positions", metavar="FILE", help="surveyed camera positions, JSON or CSV: sets metres"
    )
    rec.add_argument(
        "--scale",
        nargs="+",
        metavar="WORD",
        help="two photos and how far apart their cameras were, in metres; or metres for each unit of --poses",
    )
    rec.add_argument(
        "--poses",
        metavar="PATH",
        help="known poses: a transforms.json, a COLMAP model, or RGB-D frames as of 7-Scenes",
    )
    rec.add_argument(
        "--depth", metavar="FOLDER", help="depth images in mm, PNG of 16 bits named as the photos are"
    )
    rec.add_argument(
        "--up", choices=("x", "y", "z"), help="axis of --poses that points up; default: found in the photos"
    )
    rec.add_argument("--workspace", help="where unfinished work lives (default OUT/workspace)")
    rec.add_argument(
        "--lens", default="auto", choices=LENSES, help="COLMAP's model of the lenses (default auto)"
    )
    rec.add_argument(
        "--max-pixels",
        type=int,
        default=ReconstructionConfig.max_pixels,
        metavar="N",
        help="photos are reduced to about so many before the fit (default %(default)s)",
    )


def _reconstruct(args: argparse.Namespace, out: Output) -> None:
    """Photos -> cameras, Gaussians, mesh and planar patches.

    The photos go through structure from motion (SIFT, matching, mapping), then Gaussians are optimised against them and
    their depth is fused into a mesh. OUT/report.html shows what came out and how far it can be trusted.
    Lenses are estimated, and photos are turned upright by EXIF; NAME.mask.png beside a photo is black where it is ignored.
    Photos know no scale: name the measured positions of at least three cameras, or the distance between two. Without
    positions z is up by vertical edges and the floor is at 0.

    examples:
      warprrf reconstruct photos/ -o room --known-positions surveyed.json
      warprrf reconstruct photos/ -o room --scale IMG_0001.jpg IMG_0040.jpg 3.25
      warprrf reconstruct scan/ -o room --poses scan/transforms.json --scale 1 --up z
      where surveyed.json holds {"view_000.jpg": [1.20, 0.85, 1.60], ...} in metres
    Overlap matters most: every surface in five photos or more, loops that look across the room.
    """
    known = read_positions(args.known_positions) if args.known_positions else None
    photos = existing(args.photos)
    scale = None if args.scale is None else read_scale(args.scale)
    workspace = args.workspace or Path(args.out) / "workspace"
    out.resumes(workspace)
    reconstruction = wr.reconstruct(
        photos,
        workspace=workspace,
        poses=None if args.poses is None else existing(args.poses),
        depth=None if args.depth is None else existing(args.depth),
        known_positions=known,
        scale=scale,
        up=args.up,
        config=ReconstructionConfig(lens=args.lens, max_pixels=args.max_pixels),
        seed=args.seed,
        progress=out,
        device=args.device,
    )
    reconstruction.save(args.out)
    report = Path(args.out) / "report.html"
    reconstruction.report(report, progress=out, device=args.device)
    found = {
        "cameras": len(reconstruction.cameras),
        "Gaussians": len(reconstruction.gaussians.means),
        "triangles": len(reconstruction.mesh.faces),
    }
    text = ", ".join(f"{count} {name}" for name, count in found.items())
    out.result(f"{args.out}: {text}; see {report}", files=[args.out, report], **found)


def add_sample(add: Add) -> None:
    """Define `sample`."""
    sam = add("sample", _sample)
    sam.add_argument("scene", help="scene file that Sionna RT opens (Mitsuba's XML), or mesh file")
    add_geometry_options(sam)
    add_out(sam, "CSV file of x,y,z rows")
    sam.add_argument("-n", type=int, default=1, help="how many (default 1)")
    sam.add_argument(
        "--height", nargs=2, type=float, default=(0.8, 2.2), metavar=("LOW", "HIGH"), help="metres (0.8 2.2)"
    )
    sam.add_argument(
        "--above-ground", action="store_true", help="heights count from the ground, not from z = 0"
    )
    sam.add_argument(
        "--clearance", type=float, default=0.3, metavar="M", help="to every surface (default 0.3)"
    )


def _sample(args: argparse.Namespace, out: Output) -> None:
    """Receivers drawn evenly from a scene's air.

    A longer draw starts with a shorter one; --seed gives another.

    examples:
      warprrf sample data/lobby/scene.xml -o receivers.csv -n 60
      warprrf sample room.glb -o candidates.csv -n 200 --height 1.5 1.5 --clearance 0.5
    """
    places = wr.sample_receivers(
        load_scene(args.scene, args), args.n, z=args.height, clearance=args.clearance,
        above_ground=args.above_ground, seed=args.seed, device=args.device,
    )  # fmt: skip
    write_text(args.out, f"x,y,z\n{_rows(places)}\n")
    out.result(f"{args.out}: {len(places)} places", files=[args.out], places=places)


def _rows(places: Iterable[np.ndarray]) -> str:
    return "\n".join(",".join(f"{x:.12g}" for x in place) for place in places)


def add_simulate(add: Add) -> None:
    """Define `simulate`."""
    sim = add("simulate", _simulate)
    sim.add_argument("scene", help="scene file that Sionna RT opens (Mitsuba's XML), or mesh file")
    add_out(sim, "NetCDF file")
    add_point(sim, "--transmitter", "metres", required=True)
    sim.add_argument(
        "--receivers", nargs="+", required=True, help="CSV or NPY file of x,y,z rows, or x,y,z words"
    )
    add_geometry_options(sim)
    add_frequency(sim, "carrier (default 300e9)", default=300e9)
    sim.add_argument(
        "--shape", nargs=2, type=int, default=(90, 180), metavar=("H", "W"), help="pixels (90 180)"
    )
    sim.add_argument("--engine", choices=("exact", "sionna"), default="exact", help="default exact")
    add_effects(sim, "what exact models, by default single bounces, without noise")
    sim.add_argument("--depth", type=int, help="most interactions (sionna; default 3)")
    sim.add_argument("--samples", type=int, help="rays per transmitter (sionna; default 1e6)")
    sim.add_argument("--beam-sigma-deg", type=float, default=2.0, help="receiver beam (default 2 degrees)")
    sim.add_argument(
        "--refraction", action="store_const", const=True, help="transmission through walls (sionna)"
    )
    sim.add_argument("--gas", action="store_true", help="absorption by standard air (ITU-R P.676)")


def _simulate(args: argparse.Namespace, out: Output) -> None:
    """Radio spectra of a scene at given receivers.

    `exact` evaluates line of sight, mirror reflections and scattering on Warp's mesh rays: single bounces without sampling
    noise; with --effects also what comes over more surfaces, sampled.
    `sionna` asks Sionna RT's PathSolver (extra: sionna) for line of sight, mirror and diffuse paths up to --depth.
    A killed run continues: finished receivers wait in OUT.receivers/. An eighth of the receivers is marked for test.
    A spectrum is path gain per pixel over the full sphere, spread by the receiver beam; its sum is the total path gain.

    examples:
      warprrf simulate data/lobby/scene.xml -o one.nc --transmitter 2 3 3.2 --receivers 7,4,1.5 9,5,1.5
      warprrf simulate room.glb -o one.nc --transmitter 2 3 3.2 --receivers 7,4,1.5 --materials materials.json
      warprrf simulate data/lobby/scene.xml -o many.nc --transmitter 2 3 3.2 --receivers receivers.csv --engine sionna
      warprrf simulate data/lobby/scene.xml -o all.nc --transmitter 2 3 3.2 --receivers 7,4,1.5 --effects everything
    """
    solver = ("depth", "samples", "refraction")
    how = {name: getattr(args, name) for name in solver if getattr(args, name) is not None}
    if args.engine == "exact":
        refuse(args, solver, "engine exact has --effects instead")
    if args.effects is not None:
        if args.engine != "exact":
            refuse(args, ["effects"], f"engine {args.engine} has its own: --depth, --refraction")
        effects = read_effects(args.effects)
        if not isinstance(effects, wr.Effects) and effects not in SETS:
            raise ValueError(
                f"--effects: got {args.effects!r}, expected {', '.join(SETS)}, or fields of wr.Effects in JSON"
            )
        how["effects"] = SETS.get(effects, effects)
    unfinished = Path(f"{args.out}.receivers")
    there = os.listdir(unfinished) if unfinished.is_dir() else []
    if there and RECORDS not in there:  # it is removed in the end
        raise ValueError(
            f"--out: got {args.out!r}, but {unfinished} is no earlier run's; expected another name"
        )
    out.resumes(unfinished)
    dataset = wr.simulate(
        load_scene(args.scene, args),
        transmitter=args.transmitter,
        receivers=read_receivers(args.receivers),
        frequency_hz=args.frequency,
        shape=tuple(args.shape),
        engine=args.engine,
        beam_sigma_rad=np.deg2rad(args.beam_sigma_deg),
        gas=args.gas,
        seed=args.seed,
        workspace=unfinished,
        progress=out,
        device=args.device,
        **how,
    )
    dataset.save(args.out)
    shutil.rmtree(unfinished)  # the finished receivers of a killed run are not needed any more
    out.result(
        f"{args.out}: {len(dataset)} spectra of {args.shape[0]} x {args.shape[1]} pixels, {args.engine}",
        files=[args.out], spectra=len(dataset), shape=args.shape, engine=args.engine,
    )  # fmt: skip


def add_fit(add: Add) -> None:
    """Define `fit`."""
    fit = add("fit", _fit)
    fit.add_argument(
        "geometry", help="a reconstruction's folder, splats (.ply), a scene (.xml) or a mesh file"
    )
    fit.add_argument(
        "measurements", nargs="+",
        help="files of spectra (.nc, or .npz of arrays), tables of received power (.csv), folders of arrays' spectra",
    )  # fmt: skip
    add_out(fit, "field file (.safetensors)")
    add_measured_options(fit)
    fit.add_argument(
        "--model", choices=("bistatic", "rf3dgs+", "rf3dgs"), default="bistatic", help="default bistatic"
    )
    fit.add_argument(
        "--train",
        type=int,
        metavar="N",
        help="receivers of the nested training subset (default: all for training)",
    )
    add_geometry_options(fit, splats="GEOMETRY")
    fit.add_argument(
        "--relevance", metavar="FILE", help="what `warprrf relevance -o` wrote: effects ruled out are off"
    )
    add_effects(fit, "bistatic: what is modelled, auto (default, what receivers held out say)")
    fit.add_argument("--iterations", type=int, help="optimiser steps (default: the model's)")
    fit.add_argument(
        "--quick",
        action="store_true",
        help="bistatic: one ray a pixel, nothing held out to decide by; two or three dB less, in seconds",
    )
    fit.add_argument(
        "--reciprocal",
        action="store_true",
        help="bistatic: scattering that is the same when transmitter and receiver change places",
    )
    fit.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="any option of the model; see below",
    )


def _fit(args: argparse.Namespace, out: Output) -> None:
    """A radio field from geometry and measured spectra.

      bistatic  line of sight, mirrors and scattering lobes of material groups; holds for other transmitters too
      rf3dgs+   directional gain per Gaussian times the path-length law; delay and departure angle from geometry
      rf3dgs    directional gain without lengths; delay and departure angle as trained channels of their own

    examples:
      warprrf fit room spectra.nc -o field.safetensors
      warprrf fit room.glb spectra.nc -o field.safetensors
      warprrf fit scan.stl spectra.nc -o field.safetensors --unit mm --simplify 200000
      warprrf fit splats.ply spectra.nc --mesh mesh.ply -o field.safetensors --model rf3dgs --train 50
      warprrf fit room spectra.nc -o field.safetensors --effects '{"scatterings":1,"mirrors":1}'
      warprrf fit room.glb horn.csv -o field.safetensors --frequency 300e9 --noise-floor-db -120 --receive-pattern 10
      warprrf fit room horn.csv receive-pattern=10 power.csv samples=1 -o f.safetensors --frequency 300e9 --noise-floor-db -120

    options of a model, as of RadioField.fit in Python (--option lobes=[0,12] --option sub_pixels=2):
      bistatic       effects, lobes, reciprocal, sub_pixels, quick, gain_offset, iterations
      rf3dgs(+)      transmittance, interaction_point, gain, sh_degree, top_k, line_of_sight, iterations, batch,
                     train_opacity, checkpoint
    """
    geometry = load_geometry(args.geometry, args)
    data = read_measured(args.measurements, args)
    given: list[tuple[str, Any]] = [_option(text) for text in args.option]
    if args.relevance is not None:
        given.append(("relevance", wr.Relevance.load(existing(args.relevance))))
    given += [(name, True) for name in ("quick", "reciprocal") if getattr(args, name)]
    if args.effects is not None:
        given.append(("effects", read_effects(args.effects)))
    if args.iterations is not None:
        given.append(("iterations", args.iterations))
    options = dict(given)
    if len(options) < len(given):
        names = [name for name, _ in given]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"--option: got {twice} twice, by itself or as --{twice}; expected each option once")
    for option in ("relevance", "quick", "reciprocal", "effects"):
        if option in options and args.model != "bistatic":
            raise ValueError(f"--{option}: only the bistatic model takes it, got --model {args.model}")
    if "checkpoint" in options:
        out.resumes(str(options["checkpoint"]))
    field = wr.RadioField.fit(
        geometry,
        data[0] if len(data) == 1 else data,
        model=args.model,
        seed=args.seed,
        progress=out,
        device=args.device,
        **options,
    )
    field.save(args.out)
    places = sum(len(np.unique(one.receivers, axis=0)) for one in data)
    chains, wrong = (field.report.get(name, {}) for name in ("chains", "unexplained"))
    lines = [f"{args.out}: {args.model} fitted on {places} receivers"]
    for name, chain in chains.items():
        lines.append(f"gain of {name}: {chain['gain_db']:.2f} +- {chain['std_db']:.2f} dB")
    for name, rows in wrong.items():
        lines.append(f"{name}: left out as wrong, counted from 0: {', '.join(map(str, rows))}")
    fitted = {
        name: field.report.get(name)
        for name in ("noise_db", "azimuth_zero_deg", "clock_offset_s", "position_offset_m")
    }
    for name, zero in (fitted["azimuth_zero_deg"] or {}).items():
        lines.append(f"{name}: add {zero:.2f} degrees to its azimuths")
    for name, zero in (fitted["clock_offset_s"] or {}).items():
        lines.append(f"{name}: add {1e9 * zero:.2f} ns to its delays")
    for name, moved in (fitted["position_offset_m"] or {}).items():
        for place, offset in np.round(moved, 4):
            lines.append(f"{name}: the receiver at {_rows([place])} stood off by {_rows([offset])} m")
    for name, noise in (fitted["noise_db"] or {}).items():
        lines.append(f"{name}: readings are {noise:.2f} dB from the field (standard deviation)")
    found = {"model": args.model, "receivers": places, "chains": chains, "unexplained": wrong, **fitted}
    out.result("\n".join(lines), files=[args.out], **found)


def _option(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals or name in ("model", "seed", "device"):
        raise ValueError(f"--option: got {text!r}, expected {f'--{name}' if equals else 'NAME=VALUE'}")
    return name, (read_effects if name == "effects" else read_json_or_text)(value)


def add_suggest(add: Add) -> None:
    """Define `suggest`."""
    sug = add("suggest", _suggest)
    sug.add_argument(
        "source", help="a field (.safetensors), or geometry as of `warprrf fit` before any measurement"
    )
    sug.add_argument("candidates", nargs="+", help="CSV or NPY file of x,y,z rows, or x,y,z words")
    sug.add_argument("-n", type=int, default=1, help="how many (default 1)")
    add_out(sug, "CSV file of the places chosen, best first", required=False)
    add_point(sug, "--transmitter", "metres; of geometry")
    add_frequency(sug, "carrier (a field's own)")
    add_pattern(
        sug,
        "--receive-pattern",
        "of a horn that candidates x,y,z,azimuth,elevation turn; isotropic: power alone",
    )
    add_geometry_options(sug, splats="SOURCE")


def _suggest(args: argparse.Namespace, out: Output) -> None:
    """Where to measure next: the candidates whose spectra lower the expected error most.

    A field knows where it was fitted. Before any measurement surfaces are taken for what ITU-R P.2040 says of building
    materials; give the transmitter and the carrier then.

    examples:
      warprrf suggest room.glb candidates.csv -n 3 --transmitter 13.6 11.2 2.5 --frequency 300e9
      warprrf suggest field.safetensors candidates.csv -n 3 -o next.csv
      warprrf suggest field.safetensors 2,3,1.5,-90,0 2,3,1.5,90,0 7,4,1.5,0,0 -n 2 --receive-pattern 10
    """
    source, turned = existing(args.source), {}
    if args.receive_pattern in (None, "isotropic"):
        pointings = read_receivers(args.candidates, "candidates")
        arrival = np.full((len(pointings), 2), 0.5 * np.pi)
    else:
        pointings = read_receivers(args.candidates, "candidates", POINTINGS)
        arrival = np.radians(np.column_stack([90.0 - pointings[:, 4], pointings[:, 3]]))
    if args.receive_pattern is not None:
        turned = {"arrival": arrival, "receive_pattern": read_pattern(args.receive_pattern)}
    if source.suffix.lower() == ".safetensors":
        refuse(args, ("transmitter", *OF_GEOMETRY), f"{source} is a field, which has its own")
        field = load_field(source, args)
    else:
        for flag in ("transmitter", "frequency"):
            if getattr(args, flag) is None:
                raise ValueError(f"--{flag}: {source} needs it, it is no field")
        nothing = wr.SpectrumDataset.empty(transmitter=args.transmitter, frequency_hz=args.frequency)
        field = wr.RadioField.fit(load_geometry(args.source, args), nothing, device=args.device, progress=out)
    chosen = pointings[field.suggest(pointings[:, :3], args.n, **turned, progress=out)]
    rows = _rows(chosen)
    if args.out:
        write_text(args.out, f"x,y,z{',azimuth,elevation' * (chosen.shape[1] == 5)}\n{rows}\n")
    out.result(rows, files=[args.out] if args.out else [], places=chosen)


def add_locate(add: Add) -> None:
    """Define `locate`."""
    loc = add("locate", _locate)
    loc.add_argument("field", help="a bistatic field's file (.safetensors)")
    loc.add_argument(
        "measurements", nargs="+", help="of one receiver: files of spectra (.nc, .npz), tables of received power (.csv)"
    )  # fmt: skip
    loc.add_argument(
        "--receiver", type=int, metavar="K", help="which one of the spectra, from 0 (the only one)"
    )
    loc.add_argument(
        "--map", metavar="FILE", help="NetCDF file that keeps the field's map for the next question"
    )
    add_measured_options(loc)
    add_out(loc, "JSON file of what was found", required=False)


def _locate(args: argparse.Namespace, out: Output) -> None:
    """Where a receiver is, by what it read.

    Where the files say that it stood is not looked at. Gains of the chains that a table names are found too, and with
    `--azimuth unknown` or `--clock unknown` the zero that its azimuths or delays count from.

    examples:
      warprrf locate field.safetensors spectra.nc --receiver 3
      warprrf locate field.safetensors horn.csv --noise-floor-db -150 --receive-pattern 10 --azimuth unknown
    """
    field = wr.RadioField.load(existing(args.field), device=args.device)
    measured = []
    for one in read_measured(args.measurements, args, others=True, frequency_hz=field.frequency_hz):
        if isinstance(one, Path):
            ds = load_spectra(one)
            if args.receiver is None and len(ds) != 1:
                raise ValueError(f"--receiver: {one} has {len(ds)} receivers, expected the number of one")
            check_count("--receiver", args.receiver or 0, 0, len(ds) - 1)
            one = ds.subset([args.receiver or 0])
        measured.append(one)
    if not any(isinstance(one, wr.SpectrumDataset) for one in measured):
        refuse(args, ["receiver"], "no file of spectra is given; a table is of one receiver")
    found = field.locate(measured, store=args.map, progress=out)
    figures = "position", "covariance", "candidates", "likelihoods", "known", "misfit"
    zeros = "gains_db", "azimuth_zeros", "clock_offsets_s"
    result = {name: getattr(found, name) for name in (*figures, *zeros)}
    if args.out:
        write_json(args.out, plain(result))
    said = "known" if found.known else "not known: see candidates"
    text = f"{' '.join(f'{x:.3f}' for x in found.position)} m, give or take {found.std_m:.3f} m ({said})"
    out.result(text, files=[args.out] if args.out else [], **result)


def add_evaluate(add: Add) -> None:
    """Define `evaluate`."""
    eva = add("evaluate", _evaluate)
    eva.add_argument("field", help="field file (.safetensors)")
    eva.add_argument("spectra", help="NetCDF file of spectra with held-out receivers")
    eva.add_argument(
        "--train",
        type=int,
        metavar="N",
        help="training receivers that the lookups see (default: as many as the field)",
    )
    eva.add_argument("--no-lookups", dest="lookups", action="store_false", help="the field alone")
    add_out(eva, "JSON file of the figures", required=False)


def _evaluate(args: argparse.Namespace, out: Output) -> None:
    """A field's errors on receivers it was not fitted on.

    Whole receivers are held out, the same for every method; beside the field stand lookups that know no geometry (nearest
    measurement, inverse distance, a constant, the mean image). `blocked` counts receivers without line of sight alone.
    A field knows which receivers it was fitted on: if the file names one of them for test, nothing is scored.

    examples:
      warprrf evaluate field.safetensors spectra.nc --train 50 -o figures.json
    """
    from warprrf.rf.spectra import lookups, metrics

    field = wr.RadioField.load(existing(args.field), device=args.device)
    dataset = load_spectra(args.spectra)
    there = int(np.count_nonzero(dataset.role == "train"))
    count = min(max(len(field.fitted_on), 1), there)
    train, test = dataset.split(count if args.train is None else args.train, seed=args.seed)
    learned = field.was_fitted_on(test)
    if learned.any():
        raise ValueError(
            f"{args.field}: was fitted on {learned.sum()} of the {len(test)} test receivers of {args.spectra}, the first "
            f"at {test.receivers[learned][0].tolist()}; score it on receivers that it never saw, or fit it again without"
        )
    methods: dict[str, Any] = {field.model: field.spectrum}
    if args.lookups:
        known = (lookups.nearest, lookups.idw, lookups.constant, lookups.mean)
        methods |= {lookup.name: lookup for lookup in (build(train) for build in known)}
    figures: dict[str, dict[str, Any]] = {}
    for name, predictor in methods.items():
        figures[name] = metrics.evaluate(
            test, predictor, progress=lambda _, *count, name=name: out(f"evaluate {name}", *count)
        )
    if args.out:
        write_json(args.out, figures)
    out.result(table(figures), files=[args.out] if args.out else [], methods=figures)


def add_relevance(add: Add) -> None:
    """Define `relevance`."""
    rel = add("relevance", _relevance)
    rel.add_argument(
        "source",
        help="scene (.xml), mesh file, reconstruction's folder, splats (.ply) or field (.safetensors)",
    )
    add_out(rel, "JSON file; the table goes beside it as Markdown", required=False)
    rel.add_argument("--spectra", help="NetCDF file whose transmitter, carrier and receivers are used")
    add_point(rel, "--transmitter", "metres")
    rel.add_argument("--receivers", nargs="+", help="CSV or NPY file of x,y,z rows, or x,y,z words")
    add_frequency(rel, "carrier (a field's own)")
    rel.add_argument("--tolerance", type=float, default=0.1, metavar="DB", help="default 0.1")
    rel.add_argument(
        "--most", type=int, default=12, metavar="N", help="receivers used, drawn by --seed (default 12)"
    )
    add_geometry_options(rel, splats="SOURCE")


def _relevance(args: argparse.Namespace, out: Output) -> None:
    """What each effect is worth in a scene, and the smallest model.

    Each effect is left out of the full model in turn: line of sight, mirrors, diffuse bounces, lobes, what no receiver
    sees, and, as estimates, the air, diffraction and transmission. What it is worth is the larger of the changes of the dB
    image and of the total path gain, rms over receivers. The smallest model within the tolerance follows; a fit can use it.

    examples:
      warprrf relevance data/lobby/scene.xml --spectra data/lobby/spectra.nc -o relevance.json
      warprrf relevance data/lobby/scene.xml --transmitter 2 3 3.2 --receivers 7,4,1.5 9,5,1.5 --frequency 140e9
      warprrf relevance field.safetensors --receivers receivers.csv --tolerance 0.5
      warprrf fit room spectra.nc -o field.safetensors --relevance relevance.json
    """
    source = existing(args.source)
    if args.out and Path(args.out).suffix == ".md":
        raise ValueError(f"--out: got {args.out!r}, expected JSON's name: the table goes beside it as .md")
    files = [Path(args.out), beside(args.out, ".md")] if args.out else []
    given = {"transmitter": args.transmitter, "frequency_hz": args.frequency}
    receivers = None if args.receivers is None else read_receivers(args.receivers)
    if args.spectra is not None:
        dataset = load_spectra(args.spectra)
        given = {name: getattr(dataset, name) if value is None else value for name, value in given.items()}
        receivers = dataset.receivers if receivers is None else receivers
    if receivers is None:
        raise ValueError("--receivers: none given, expected positions, or --spectra with some")
    check_count("--most", args.most)
    if len(receivers) > args.most:
        receivers = receivers[np.random.default_rng(args.seed).permutation(len(receivers))[: args.most]]
    if source.suffix.lower() == ".safetensors":
        refuse(args, OF_GEOMETRY, f"{source} is a field, which has its own")
        geometry = load_field(source, args)
    else:
        geometry = load_geometry(args.source, args)
    found = wr.relevance(
        geometry,
        receivers=receivers,
        tolerance_db=args.tolerance,
        progress=out,
        device=args.device,
        **given,
    )
    if files:
        found.save(files[0])
        write_text(files[1], found.table() + "\n")
    out.result(found.table(), files=files, **found.to_dict())
