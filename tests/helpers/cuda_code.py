"""What the CUDA compiler in Warp's wheel makes of the library's kernels: registers, local memory, instructions.

``python tests/helpers/cuda_code.py`` writes ``tests/golden/cuda_kernels.json``, the figures of the kernels of :data:`HOT`;
``tests/test_cuda_kernels.py`` compares. They stand in the compiled file, an ELF: no card and no other tool is needed.
"""

import importlib
import inspect
import itertools
import json
import pkgutil
import re
import struct
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import warp as wp

import warprrf.kernels

TABLE = Path(__file__).parent.parent / "golden" / "cuda_kernels.json"
ARCHITECTURE = 90  # an H100's
CHOICES = {
    "real": (wp.float32, wp.float64),
    "rule": (0, 1),
    "width": (1, 4),
    "lanes": (1,),  # of a GPU
    "channels": (1, 3),
}  # what builders of kernels are asked for
FOR_A_CPU_ALONE = "warprrf.kernels.raster.blocks"  # a GPU blends by `reference`
EVERY = pkgutil.walk_packages(warprrf.kernels.__path__, "warprrf.kernels.")
MODULES = sorted(m.name for m in EVERY if not m.ispkg and m.name != FOR_A_CPU_ALONE)
HOT = {
    "warprrf.kernels.raster.project": ("project(float32)", "chain(float32)"),
    "warprrf.kernels.raster.reference": (
        "blend(float32, 4)", "blend_adjoint(float32, 4)", "blend_stretches(float32, 4)", "strongest(float32)",
    ),
    "warprrf.kernels.rays.gaussians": ("collect", "collect_adjoint", "transmit", "transmit_adjoint"),
    "warprrf.kernels.rays.mesh": ("cast_rays", "see"),
    "warprrf.kernels.radio.beam": ("gather_beams",),
    "warprrf.kernels.radio.harmonics": ("predict(float32)", "coefficient_adjoint(float32)"),
}  # fmt: skip
"""Kernels that a GPU spends its time in."""


@dataclass(frozen=True)
class Code:
    """One kernel, compiled.

    Attributes:
        registers: of a thread; 64 or less let 1024 threads share a multiprocessor, 255 is the most.
        local_bytes: of a thread's arrays and spilled registers, which lie in memory.
        instructions: of the whole kernel: no fewer than one turn of its loop takes (a Gaussian of a pixel, say).
    """

    registers: int
    local_bytes: int
    instructions: int


def kernels_of(name):
    """Kernels of one module by label, those that its builders make for both precisions and all rules included."""
    module = importlib.import_module(name)
    found = [("", value) for value in vars(module).values()]
    for builder in (f for key, f in vars(module).items() if key.startswith("build")):
        needed = [p.name for p in inspect.signature(builder).parameters.values() if p.default is p.empty]
        if set(needed) <= set(CHOICES):  # others make functions, which the kernels call
            for arguments in itertools.product(*(CHOICES[p] for p in needed)):
                label = f"({', '.join(getattr(a, '__name__', str(a)) for a in arguments)})"
                made = builder(*arguments)
                values = [made] if isinstance(made, wp.Kernel) else vars(made).values()
                found += [(label, value) for value in values]
    return {
        k.func.__name__ + label: k
        for label, k in found
        if isinstance(k, wp.Kernel) and k.func.__module__ == name
    }


def compiled(kernels, folder):
    """:class:`Code` of each of ``kernels`` by label; a kernel that the compiler left out has none."""
    found = {}
    for paths, own in _files(kernels, folder, use_ptx=False):
        code = {}
        for path in paths:
            code |= _code(path.read_bytes()) if path.suffix == ".cubin" else {}
        for label, kernel in own.items():
            named = re.compile(rf"{kernel.key}_[0-9a-f]{{8}}_cuda_kernel_forward")
            found.update((label, c) for name, c in code.items() if named.fullmatch(name))
    return found


def translated(kernels, folder):
    """Labels of ``kernels`` that are in the compiler's PTX, which takes half as long as machine code."""
    found = set()
    for paths, own in _files(kernels, folder, use_ptx=True):
        text = "".join(path.read_text() for path in paths).replace(".visible", "")
        found |= {label for label, kernel in own.items() if f".entry {kernel.key}" in text}
    return found


def _files(kernels, folder, use_ptx):
    """The files that each module of ``kernels`` is compiled to, and its kernels by label."""
    for module in {k.module for k in kernels.values()}:
        paths = wp.compile_aot_module(module, arch=ARCHITECTURE, use_ptx=use_ptx, module_dir=folder)
        yield paths, {label: k for label, k in kernels.items() if k.module is module}


REGISTERS, LOCAL = 0x2F, 0x12  # EIATTR_REGCOUNT, EIATTR_MIN_STACK_SIZE, as `cuobjdump -elf` names them
VALUE = 4  # the format of an attribute that a value follows
BYTES_AN_INSTRUCTION = 16  # since Volta


def _code(cubin):
    """Every kernel of an ELF file of 64 bits: the length of its code's section, and its attributes in ``.nv.info``."""
    (table,) = struct.unpack_from("<Q", cubin, 0x28)
    size, count, names = struct.unpack_from("<HHH", cubin, 0x3A)
    heads = [struct.unpack_from("<IIQQQQIIQQ", cubin, table + size * k) for k in range(count)]
    body = [cubin[head[4] : head[4] + head[5]] for head in heads]
    section = {_text(body[names], head[0]): k for k, head in enumerate(heads)}
    symbols, symbol_names = body[section[".symtab"]], body[section[".strtab"]]
    info, at, told = body[section[".nv.info"]], 0, {}
    while at < len(info):
        kind, attribute, length = struct.unpack_from("<BBH", info, at)
        if kind == VALUE and attribute in (REGISTERS, LOCAL):
            symbol, value = struct.unpack_from("<II", info, at + 4)
            name = _text(symbol_names, struct.unpack_from("<I", symbols, 24 * symbol)[0])
            told[name, attribute] = value
        at += 4 + (length if kind == VALUE else 0)
    return {
        name.removeprefix(".text."): Code(
            told[name.removeprefix(".text."), REGISTERS],
            told[name.removeprefix(".text."), LOCAL],
            len(body[k]) // BYTES_AN_INSTRUCTION,
        )
        for name, k in section.items()
        if name.startswith(".text.")
    }


def _text(strings, at):
    return strings[at : strings.index(b"\0", at)].decode()


def main():
    figures = {}
    for name, labels in HOT.items():
        kernels = kernels_of(name)
        with tempfile.TemporaryDirectory() as folder:
            code = compiled({label: kernels[label] for label in labels}, folder)
        figures[name] = {label: asdict(code[label]) for label in labels}
    result = {"warp": wp.__version__, "architecture": ARCHITECTURE, "kernels": figures}
    TABLE.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
