#!/usr/bin/env bash
# Print the first Python of at least 3.11 that can make virtual environments; 3.11 first, it is what CI runs.
set -euo pipefail
for python in ${PYTHON:-} python3.11 python3.12 python3.13 python3 python; do
  if "$python" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then
    command -v "$python"
    exit 0
  fi
done
echo "No Python >= 3.11 with venv found. Debian and Ubuntu: sudo apt-get install -y python3 python3-venv" >&2
echo "Or name one: make PYTHON=/path/to/python3.11" >&2
exit 1
