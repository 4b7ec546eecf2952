"""`python -m benchmarks NAME`: the lobby, its data, and every table and figure."""

from __future__ import annotations

import argparse
import sys

from benchmarks.commands import add_benches
from benchmarks.lobby.commands import add_data, add_lobby
from warprrf import cli

EPILOG = """\
  python -m benchmarks lobby            photos -> geometry -> radio -> evaluation, into runs/lobby/
  python -m benchmarks data             regenerate data/lobby/
  python -m benchmarks bistatic         one table of figures; `python -m benchmarks NAME --help` explains each
"""


def parser() -> argparse.ArgumentParser:
    """Every benchmark as a command."""
    return cli.make_parser(
        "python -m benchmarks",
        "Experiments: every table and figure from one command each.",
        EPILOG,
        (add_lobby, add_data, add_benches),
    )


if __name__ == "__main__":
    sys.exit(cli.run(parser()))
