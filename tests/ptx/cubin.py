"""What a kernel takes of a GPU, read from the machine code that NVRTC makes of it: registers, shared and local memory.

A cubin is an ELF file. Its ``.nv.info`` records are a format byte, an attribute byte and two bytes of size, then the
payload: symbol and value for registers (0x2f), stack frame (0x11) and least stack (0x12).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

REGISTERS, FRAME, STACK = 0x2F, 0x11, 0x12
WITH_PAYLOAD = 4  # format of a record with a size and a payload


@dataclass(frozen=True)
class Resources:
    """Of one entry: registers a thread, static and reserved shared bytes a block, local bytes a thread (arrays and
    spilled registers)."""

    registers: int
    shared_bytes: int
    local_bytes: int


def read(path: Path) -> dict[str, Resources]:
    """Resources of every entry of a cubin.

    Raises:
        ValueError: if the file is no 64-bit ELF file, or says nothing of registers.
    """
    data = path.read_bytes()
    if data[:5] != b"\x7fELF\x02":
        raise ValueError(f"path: {path} begins with {data[:5]!r}, expected a 64-bit ELF file")
    (begin,) = struct.unpack_from("<Q", data, 0x28)
    size, count, names_at = struct.unpack_from("<HHH", data, 0x3A)
    # name, type, flags, address, offset, size, link, info, align, entry size
    sections = [struct.unpack_from("<IIQQQQIIQQ", data, begin + k * size) for k in range(count)]

    def text(section: tuple[int, ...], offset: int) -> str:
        at = section[4] + offset
        return data[at : data.index(b"\0", at)].decode()

    named = {text(sections[names_at], s[0]): s for s in sections}
    symbols = named[".symtab"]
    symbol_names = [
        text(sections[symbols[6]], struct.unpack_from("<I", data, symbols[4] + 24 * k)[0])
        for k in range(symbols[5] // 24)
    ]
    found: dict[int, dict[str, int]] = {REGISTERS: {}, FRAME: {}, STACK: {}}
    for name, section in named.items():
        if not name.startswith(".nv.info"):
            continue
        at, end = section[4], section[4] + section[5]
        while at < end:
            form, attribute, length = struct.unpack_from("<BBH", data, at)
            at += 4
            if form != WITH_PAYLOAD:
                continue
            if attribute in found and length == 8:
                symbol, value = struct.unpack_from("<II", data, at)
                found[attribute][symbol_names[symbol]] = value
            at += length
    if not found[REGISTERS]:
        raise ValueError(f"path: {path} has no record of registers")
    return {
        name: Resources(
            registers=registers,
            shared_bytes=named[f".nv.shared.{name}"][5] if f".nv.shared.{name}" in named else 0,
            local_bytes=max(found[FRAME].get(name, 0), found[STACK].get(name, 0)),
        )
        for name, registers in found[REGISTERS].items()
    }
