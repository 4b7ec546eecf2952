"""Warp kernels as they are compiled for CUDA, run on a CPU.

NVRTC, which Warp's wheel brings, compiles a kernel to PTX; :mod:`ptx.translate` makes C++ of it, Warp's clang an object
file, and :func:`launch` runs that over a grid of blocks on arrays in CPU memory. So the ``__CUDA_ARCH__`` branches,
shuffles, shared memory, barriers and atomics of a kernel run in a test without a GPU.

What is found out: instructions that are not known, addresses that are null, misaligned or beyond shared memory,
barriers that some threads never reach, shuffles from lanes that are not there, loops without end. Shared memory is
filled with NaN patterns before each block; ``order`` runs threads and blocks in another order, so that a result which
depends on scheduling, as with a barrier left out, shows. What is not: caches, memory that other blocks write at the
same time, speed.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import re
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
import warp._src.codegen as warp_codegen
import warp._src.context as warp_context
from warp._src.build import build_cpu

from ptx import cubin
from ptx.parse import UnknownPtx, parse
from ptx.translate import Program, translate

__all__ = ["Fault", "UnknownPtx", "launch", "resources", "run"]

ARCH = 80
BUDGET = 1 << 33  # backward branches of a launch: minutes of work
HERE = Path(__file__).parent
FAULTS = {
    1: "trap executed",
    2: "access to address {address:#x}, which is no memory",
    3: "access to address {address:#x}, which is not aligned to the access",
    4: "access to byte {address} of shared memory, beyond its {shared_bytes} or not aligned",
    5: "deadlock",
    6: "the thread is not in the mask of its own operation",
    7: "shuffle from lane {address}, which is not in the mask or has left the kernel",
    8: "lanes of one warp wait at different instructions for one barrier, the other is thread {address}",
    9: f"more than {BUDGET} backward branches: a loop that does not end",
    10: "assertion failed: {assertion}",
    11: "more threads came to barrier {address} than it waits for",
}
WAITS = ("nothing", "barrier {mask}", "warp barrier {mask:#x}", "shuffle {mask:#x}", "vote {mask:#x}",
         "match {mask:#x}", "reduction {mask:#x}", "activemask")  # fmt: skip


class Fault(RuntimeError):
    """What a GPU would not have done either: the message names block, thread and instruction."""


class _Thread(ctypes.Structure):
    _fields_ = [(name, ctypes.c_uint32) for name in ("state", "wait", "site", "kind", "mask", "count")] + [
        ("value", ctypes.c_uint64), *((name, ctypes.c_uint32) for name in ("lane_from", "clamp", "flag", "arrives"))
    ]  # fmt: skip


_Print = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)


class _Context(ctypes.Structure):
    _fields_ = [
        ("params", ctypes.c_void_p), ("shared", ctypes.c_void_p), ("shared_bytes", ctypes.c_uint64),
        ("threads", ctypes.c_void_p), ("registers", ctypes.c_void_p), ("lane_order", ctypes.c_void_p),
        ("warp_order", ctypes.c_void_p), ("block_order", ctypes.c_void_p), ("counts", ctypes.c_void_p),
        ("print", _Print), ("blocks", ctypes.c_uint64), ("block", ctypes.c_uint64), ("budget", ctypes.c_int64),
        ("address", ctypes.c_uint64), ("block_dim", ctypes.c_uint32), ("thread", ctypes.c_uint32),
        ("fault", ctypes.c_uint32), ("site", ctypes.c_uint32), ("arrived", ctypes.c_uint32 * 16), ("jump", ctypes.c_void_p),
    ]  # fmt: skip


@dataclass(frozen=True)
class Executable:
    """A loaded program: its entry point and what is known of it."""

    program: Program
    run: Any
    register_bytes: int


def launch(
    kernel: wp.Kernel,
    dim: int | Sequence[int],
    inputs: Sequence[Any],
    *,
    block_dim: int = 256,
    adjoint: bool = False,
    blocks: int | None = None,
    count: bool = False,
    order: str | int | None = None,
) -> dict[str, int] | None:
    """Run a kernel's PTX, as ``wp.launch`` would run it on a GPU.

    Args:
        dim: of the launch; for a tiled kernel append ``block_dim``, as ``wp.launch_tiled`` does.
        inputs: arguments as for ``wp.launch``, arrays in CPU memory; gradients are those of the arrays.
        adjoint: run the kernel's adjoint.
        blocks: of the grid at most (a grid-stride loop does the rest); ``None``: one for each ``block_dim`` indices.
        count: return executed instructions by class; memory accesses are also counted in bytes.
        order: of threads and blocks: ascending, "reversed", or a seed of random ones.

    Raises:
        Fault: for a deadlock, a bad address and the like.
        UnknownPtx: for an instruction that is not known.
        ValueError: if the grid or an argument does not fit.
    """
    if not 1 <= block_dim <= 1024:
        raise ValueError(f"block_dim: got {block_dim}, expected 1 to 1024")
    if kernel.is_generic:
        kernel = kernel._add_normalized_overload(kernel.infer_argument_types(list(inputs)))
    dim, size = warp_context._normalize_launch_dim(dim)
    if size == 0:
        return {} if count else None
    text, meta, names = compile_kernel(kernel, block_dim)
    entry = names[1] if adjoint else names[0]
    arguments = list(kernel.adj.args)
    if len(inputs) != len(arguments):
        raise ValueError(f"inputs: got {len(inputs)}, expected {len(arguments)} for kernel {kernel.key}")
    params = [warp_context._build_launch_bounds_from_tuple(dim, kernel.adj.kernel_dim)]
    slopes = [a.type() if isinstance(a.type, warp_codegen.Struct) else None for a in arguments]
    for values, slope in ((inputs, False), (slopes, True))[: 1 + adjoint]:
        params += [
            warp_context.pack_arg(kernel, a.type, a.label, value, "cpu", slope)
            for a, value in zip(arguments, values, strict=True)
        ]
    needed = -(-size // block_dim)
    return run(
        text,
        entry,
        params,
        blocks=needed if blocks is None else min(blocks, needed),
        block_dim=block_dim,
        dynamic_shared_bytes=meta[f"{entry}_smem_bytes"],
        count=count,
        order=order,
    )


def run(
    text: str,
    entry: str,
    params: Sequence[Any],
    *,
    blocks: int,
    block_dim: int,
    dynamic_shared_bytes: int = 0,
    count: bool = False,
    order: str | int | None = None,
) -> dict[str, int] | None:
    """Run an entry of PTX text; ``params`` are ctypes values. See :func:`launch`."""
    executable = load(text, entry, count)
    program = executable.program
    sizes = [ctypes.sizeof(p) for p in params]
    if sizes != program.params:
        raise ValueError(f"params: got sizes {sizes} bytes, expected {program.params} for {entry}")
    warps = -(-block_dim // 32)
    pointers = (ctypes.c_void_p * len(params))(*(ctypes.addressof(p) for p in params))
    shared_bytes = program.shared_bytes + dynamic_shared_bytes
    shared = np.zeros(shared_bytes + 256, np.uint8)
    threads = (_Thread * (32 * warps))()
    registers = np.zeros(executable.register_bytes * (block_dim if program.cooperative else 0) + 64, np.uint8)
    counts = np.zeros(max(len(program.tallies), 1), np.uint64)
    lanes, order_of_warps, order_of_blocks = _orders(order, warps, blocks)
    printed = _Print(_print)
    context = _Context(
        params=ctypes.addressof(pointers),
        shared=_aligned(shared, 128),
        shared_bytes=shared_bytes,
        threads=ctypes.addressof(threads),
        registers=_aligned(registers, 16),
        lane_order=lanes.ctypes.data,
        warp_order=order_of_warps.ctypes.data,
        block_order=order_of_blocks.ctypes.data,
        counts=counts.ctypes.data,
        print=printed,
        blocks=blocks,
        budget=BUDGET,
        block_dim=block_dim,
    )
    executable.run(ctypes.byref(context))
    if context.fault:
        raise Fault(_message(entry, context, threads, program))
    if not count:
        return None
    total: dict[str, int] = {}
    for tally, times in zip(program.tallies, counts.tolist(), strict=True):
        for key, n in tally.items():
            total[key] = total.get(key, 0) + n * times
    return total


def _aligned(buffer: np.ndarray, align: int) -> int:
    return -(-buffer.ctypes.data // align) * align


def _orders(order: str | int | None, warps: int, blocks: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """In which order lanes, warps and blocks run."""
    orders = [np.arange(n) for n in (32, warps, blocks)]
    if order == "reversed":
        orders = [o[::-1] for o in orders]
    elif isinstance(order, int):
        random = np.random.default_rng(order)
        orders = [random.permutation(o) for o in orders]
    elif order is not None:
        raise ValueError(f"order: got {order!r}, expected None, 'reversed' or a seed")
    lanes, order_of_warps, order_of_blocks = orders
    return (
        np.ascontiguousarray(lanes, np.uint32),
        np.ascontiguousarray(order_of_warps, np.uint32),
        np.ascontiguousarray(order_of_blocks, np.uint64),
    )


def _message(entry: str, context: _Context, threads: Any, program: Program) -> str:
    text = "" if context.fault != 10 else ctypes.string_at(context.address).decode()
    what = FAULTS[context.fault].format(
        address=context.address, shared_bytes=context.shared_bytes, assertion=text
    )
    where = f"{entry}, block {context.block}"
    if context.fault == 5:
        waiting: dict[str, list[int]] = {}
        for t in range(context.block_dim):
            thread = threads[t]
            if thread.state == 2:
                place = "left the kernel"
            else:
                place = f"at {WAITS[thread.wait].format(mask=thread.mask)} ({program.sites[thread.site]})"
            waiting.setdefault(place, []).append(t)
        listed = "; ".join(f"{_ranges(ts)} {place}" for place, ts in waiting.items())
        return f"{where}: deadlock: threads {listed}"
    return f"{where}, thread {context.thread}: {what} ({program.sites[context.site]})"


def _ranges(numbers: list[int]) -> str:
    parts: list[list[int]] = []
    for n in numbers:
        if parts and parts[-1][1] == n - 1:
            parts[-1][1] = n
        else:
            parts.append([n, n])
    return ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in parts)


def _print(text: int, values: int) -> None:
    """A kernel's ``printf``: arguments lie behind one another, each aligned to its size."""
    form, place, out = ctypes.string_at(text).decode(), values, []
    for part in _FORMAT.split(form):
        if not part.startswith("%") or part == "%%":
            out.append("%" if part == "%%" else part)
            continue
        kind, size = part[-1], 8 if part[-1] in "feEgGsp" or "l" in part else 4
        place = -(-place // size) * size
        c_type = {"f": ctypes.c_double, "s": ctypes.c_char_p}.get(
            "f" if kind in "feEgG" else kind,
            {(8, True): ctypes.c_int64, (8, False): ctypes.c_uint64, (4, True): ctypes.c_int32}.get(
                (size, kind in "di"), ctypes.c_uint32
            ),
        )
        value = c_type.from_address(place).value
        place += size
        if kind == "c":
            value = chr(value)
        out.append((part.replace("l", "").replace("p", "x")) % (value.decode() if kind == "s" else value))
    print("".join(out), end="")


_FORMAT = re.compile(r"(%(?:%|[-+ #0]*\d*(?:\.\d+)?(?:hh|h|ll|l)?[diuoxXcsfeEgGp]))")


# From a kernel to PTX and on to machine code


def compile_kernel(kernel: wp.Kernel, block_dim: int) -> tuple[str, dict[str, int], tuple[str, str]]:
    """PTX of the kernel's module, its metadata, and the names of the kernel's forward and backward entries."""
    path = _compiled(kernel, block_dim, ARCH, "ptx")
    text, meta = _read(path, path.with_name(kernel.module._get_meta_name(block_dim=block_dim)))
    return text, meta, _entries(kernel, block_dim)


def resources(kernel: wp.Kernel, *, arch: int = 90, block_dim: int = 256) -> dict[str, cubin.Resources]:
    """Registers, shared and local memory of a kernel's machine code for ``arch``: "forward" and, if any, "backward".

    Shared memory includes what the system reserves (1024 bytes from sm_90 on), but no dynamic part.
    """
    found = cubin.read(_compiled(kernel, block_dim, arch, "cubin"))
    names = zip(("forward", "backward"), _entries(kernel, block_dim), strict=True)
    return {which: found[name] for which, name in names if name in found}


def _compiled(kernel: wp.Kernel, block_dim: int, arch: int, kind: str) -> Path:
    """PTX or cubin of the kernel's module, from the cache on disk or made now."""
    wp.init()
    module = kernel.module
    name = module.get_module_identifier(block_dim=block_dim)
    folder = _cache() / f"{name}_sm{arch}_{kind}"
    path = folder / f"{name}.{kind}"
    if not path.exists():
        options = module.resolve_options(wp.config, block_dim=block_dim)
        module._compile(None, folder, path.name, output_arch=arch, use_ptx=kind == "ptx", options=options)
    return path


def _entries(kernel: wp.Kernel, block_dim: int) -> tuple[str, str]:
    """Names of the kernel's forward and backward entries."""
    mangled = kernel.get_mangled_name(kernel_hash=kernel.module.hashers[block_dim].kernel_hashes[kernel])
    return (
        warp_codegen.cuda_kernel_forward_name(kernel, name=mangled),
        warp_codegen.cuda_kernel_backward_name(kernel, name=mangled),
    )


@cache
def _read(ptx: Path, meta: Path) -> tuple[str, dict[str, int]]:
    return ptx.read_text().rstrip("\0"), json.loads(meta.read_text())


def _cache() -> Path:
    folder = Path(wp.config.kernel_cache_dir) / "ptx_on_cpu"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@cache
def _recipe() -> bytes:
    """What decides on the machine code besides the PTX."""
    sources = [(HERE / name).read_bytes() for name in ("machine.h", "parse.py", "translate.py")]
    return b"".join([*sources, wp.config.version.encode()])


_loaded: dict[str, Executable] = {}


def load(text: str, entry: str, count: bool = False) -> Executable:
    """Machine code of an entry, from the cache on disk or made now."""
    key = hashlib.sha256(b"\0".join([_recipe(), text.encode(), entry.encode(), bytes([count])])).hexdigest()[
        :24
    ]
    if key in _loaded:
        return _loaded[key]
    wp.init()
    stored, described = _cache() / f"{key}.o", _cache() / f"{key}.json"
    if stored.exists() and described.exists():
        program = Program(**json.loads(described.read_text()))
    else:
        program = translate(_parsed(text), entry, count)
        source = program.source.replace('#include "machine.h"', (HERE / "machine.h").read_text())
        with tempfile.TemporaryDirectory(dir=_cache()) as folder:
            place = Path(folder)
            (place / "kernel.cpp").write_text(source)
            build_cpu(
                str(place / "kernel.o"), str(place / "kernel.cpp"), fuse_fp=False, optimization_level=1,
                extra_flags="-march=native -ffp-contract=off -fwrapv",
            )  # fmt: skip
            (place / "kernel.json").write_text(json.dumps(asdict(program)))
            os.replace(place / "kernel.o", stored)
            os.replace(place / "kernel.json", described)
    native = warp_context.runtime.llvm
    handle = f"ptx_{key}".encode()
    if native.wp_load_obj(str(stored).encode(), handle, wp.config.legacy_cpu_linker) != 0:
        raise RuntimeError(f"the machine code of {entry} could not be loaded from {stored}")
    call = ctypes.CFUNCTYPE(None, ctypes.POINTER(_Context))(native.wp_lookup(handle, b"ptx_run"))
    size = ctypes.CFUNCTYPE(ctypes.c_uint64)(native.wp_lookup(handle, b"ptx_registers"))()
    _loaded[key] = Executable(program, call, size)
    return _loaded[key]


@cache
def _parsed(text: str) -> Any:
    return parse(text)
