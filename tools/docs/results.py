"""README's table, and the result of the lobby; the tables of the documentation are in :mod:`tables`.

``python tools/docs/results.py readme`` writes README's table anew, ``python tools/docs/results.py keep FOLDER`` keeps
the result of a finished ``make lobby`` (``FOLDER/report.json``), without the figures of single receivers.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

from tables.common import FOLDER, NAMES, ROOT, find, markdown
from tables.paper import PLACES, paper, with_spread

README = ROOT / "README.md"
MARKERS = ("<!-- results: made by tools/docs/results.py -->", "<!-- /results -->")


def readme() -> str:
    """README's table between its markers: 100 spectra of the lobby by both engines and of the second room."""
    columns = (
        ("PSNR [dB]", "psnr_db", 1.0, "{:.1f}"),
        ("within 3° [%]", "direction_within_3deg", 100.0, "{:.0f}"),
        ("blocked, within 3° [%]", "direction_within_3deg_blocked", 100.0, "{:.0f}"),
    )
    shown = {
        place: columns[:2] if place[0] == "conference" else columns
        for place in PLACES
        if place[1] == "random"
    }

    lines = []
    for method in ("bistatic", "rf3dgs+", "rf3dgs", "nerf2", "cgan", "nearest"):
        cells = [NAMES[method]]
        for place, figures in shown.items():
            row = find(paper(*place, 100), method=method)
            cells += [with_spread(row, *how) for _, *how in figures]
        lines.append(cells)
    head = ["100 spectra", *(f"{PLACES[place]}: {name}" for place, how in shown.items() for name, *_ in how)]
    return f"{MARKERS[0]}\n{markdown(head, lines)}\n{MARKERS[1]}"


def main(arguments: list[str]) -> None:
    """``readme``, or ``keep FOLDER``."""
    if arguments[:1] == ["readme"]:
        between = re.compile(f"{re.escape(MARKERS[0])}.*{re.escape(MARKERS[1])}", re.DOTALL)
        README.write_text(between.sub(readme(), README.read_text()))
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
