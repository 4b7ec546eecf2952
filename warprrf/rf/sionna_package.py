"""Sionna RT and Mitsuba, on an LLVM and a variant that they can use.

Dr.Jit takes any LLVM on a CPU: 15 and 16 abort the process, 14 is too old, so the choice isn't left to it.
"""

from __future__ import annotations

import glob
import os
import re
from pathlib import Path
from typing import Any

from warprrf import device as _device
from warprrf.checks import checked

MIN_LLVM = 17
"""Oldest LLVM whose code generator has what Dr.Jit 1.5 asks for ("Cannot select ... fminimum" before)."""

_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/usr/lib/llvm-*/lib",
    "/opt/homebrew/opt/llvm*/lib",
)


def installed_llvm() -> dict[int, Path]:
    """The LLVM shared libraries found, by major version."""
    found: dict[int, Path] = {}
    for folder in _FOLDERS:
        for name in sorted(glob.glob(f"{folder}/libLLVM*")):
            version = re.search(r"libLLVM[-.](?:so\.)?(\d+)[\d.]*(?:\.so|\.dylib)?(?:[\d.]*)$", name)
            if version:
                found.setdefault(int(version.group(1)), Path(name).resolve())
    return found


@checked
def select_llvm() -> Path | None:
    """Point Dr.Jit at the newest LLVM of at least 17 before it is first imported; returns it.

    A ``DRJIT_LIBLLVM_PATH`` that is already set stays. None where no version is installed that Dr.Jit could take by
    mistake either (it may run on a GPU).

    Raises:
        ImportError: if only versions are installed that would abort the process.
    """
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    if chosen:
        return Path(chosen)
    found = installed_llvm()
    usable = [version for version in found if version >= MIN_LLVM]
    if usable:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(found[max(usable)])
        return found[max(usable)]
    if found:
        versions = ", ".join(str(v) for v in sorted(found))
        raise ImportError(
            f"Dr.Jit needs LLVM {MIN_LLVM} or newer, but only {versions} is installed and would abort the process: "
            "apt-get install libllvm19 (Debian, Ubuntu), or set DRJIT_LIBLLVM_PATH"
        )
    return None


def sionna_rt() -> Any:
    """Sionna RT, on a variant of Mitsuba and an LLVM that it can use."""
    select_llvm()
    select_variant()
    return _device.require("sionna.rt", extra="sionna")


def select_variant() -> Any:
    """Mitsuba, on a variant for radio: it may be on another, for photos, and Sionna needs the one of its import."""
    mitsuba = _device.require("mitsuba", extra="sionna")
    if mitsuba.variant() is None or not mitsuba.variant().endswith("mono_polarized"):
        mitsuba.set_variant("cuda_ad_mono_polarized", "llvm_ad_mono_polarized")
    return mitsuba
