"""Tables of README and of the documentation's pages, and the result of the lobby.

A page names a table by ``<!-- table: NAME -->``; what stands from there to ``<!-- /table -->`` is made of the files in
``benchmarks/results`` (:mod:`tables`). ``python tools/docs/results.py write`` makes all of them anew, ``python
tools/docs/results.py keep FOLDER`` keeps the result of a finished ``make lobby`` (``FOLDER/report.json``), without the figures of
single receivers.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

from tables import table
from tables.common import FOLDER, ROOT

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
TABLE = re.compile(r"<!-- table: ([\w-]+) -->(?:(?:(?!<!-- table: ).)*?<!-- /table -->)?", re.DOTALL)


def with_tables(text: str) -> str:
    """A page with the tables that it names."""
    return TABLE.sub(
        lambda name: f"{name[0].split(' -->')[0]} -->\n\n{table(name[1])}\n\n<!-- /table -->", text
    )


def main(arguments: list[str]) -> None:
    """``write``, or ``keep FOLDER``."""
    if arguments == ["write"]:
        for page in PAGES:
            page.write_text(with_tables(page.read_text()))
    elif arguments[:1] == ["keep"] and len(arguments) == 2:
        report = json.loads((Path(arguments[1]) / "report.json").read_text())
        for part in ("methods", "methods_sionna"):
            for row in report[part].values():
                row.pop("per_receiver", None)
        (FOLDER / "lobby.json").write_text(json.dumps(report, indent=1) + "\n")
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
