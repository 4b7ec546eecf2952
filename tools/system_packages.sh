#!/usr/bin/env bash
# Install the shared libraries that Python wheels do not bring, or say which one command does.
#   Open3D (meshing)                 libusb-1.0.so.0  libGL.so.1  libgomp.so.1     needed
#   Dr.Jit (Mitsuba, Sionna: data)   libLLVM 17 or newer; 15 and 16 abort the process, 14 is too old
#   Chromium and its driver (tests of the viewer)                                  wanted by tests alone
# `system_packages.sh llvm` also stops when LLVM is missing (making data and the whole test suite need it);
# `system_packages.sh llvm browser` wants Chromium too.
set -euo pipefail

libraries=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null || true)
has() { grep -Eq "$1" <<<"$libraries"; }

needed=() wanted=()
has 'libusb-1\.0\.so\.0' || needed+=(libusb-1.0-0)
has 'libGL\.so\.1' || needed+=(libgl1)
has 'libgomp\.so\.1' || needed+=(libgomp1)
if [[ -z "${DRJIT_LIBLLVM_PATH:-}" ]] && ! has 'libLLVM(-|\.so\.)(1[7-9]|2[0-9])'; then
  if [[ "${1:-}" == llvm ]]; then needed+=(libllvm19); else wanted+=(libllvm19); fi
fi
if [[ "${2:-}" == browser ]] && ! { command -v chromium && command -v chromedriver; } >/dev/null; then
  wanted+=(chromium chromium-driver)
fi
[[ ${#needed[@]} -eq 0 && ${#wanted[@]} -eq 0 ]] && exit 0

as_root=""
if command -v apt-get >/dev/null; then
  if [[ $(id -u) -eq 0 ]]; then
    as_root="env"
  elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
    as_root="sudo -n env"
  fi
fi
install="apt-get install -y --no-install-recommends"
try() {
  [[ $# -eq 0 ]] && return 0
  [[ -n "$as_root" ]] || return 1
  echo "Installing $*"
  $as_root DEBIAN_FRONTEND=noninteractive $install -qq "$@" >/dev/null
}
[[ -n "$as_root" ]] && { $as_root apt-get update -qq || true; }
if ! try "${needed[@]}"; then
  echo "Shared libraries are missing. This command installs them (Debian 12, Ubuntu 24.04):" >&2
  echo "    sudo $install ${needed[*]}" >&2
  exit 1
fi
if ! try "${wanted[@]}"; then
  echo "Going on without ${wanted[*]}: making data with Mitsuba and Sionna needs LLVM, tests of the viewer Chromium." >&2
  echo "    sudo $install ${wanted[*]}" >&2
fi
