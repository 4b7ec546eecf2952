"""Many receivers at once; the list of benchmarks."""

from __future__ import annotations

import re

from tables.common import entry, markdown, read, show

THREADS = 100 * 16  # of a hundred machines
LINK = 1.25e9  # bytes a second: 10 Gbit/s


@entry("batches")
def _batches() -> str:
    found = read("batches")
    columns = (
        ("receivers", "receivers", "{}"), ("wall_ms", "each [ms]", "{:.0f}"), ("core_ms", "core time [ms]", "{:.0f}"),
        ("over", "over one by one", "{:.2f}"), ("faster", "over one worker", "{:.2f}"), ("same_bits", "same bits", "{}"),
        ("gigabytes", "on disk [GB]", "{:.2f}"), ("peak_gb", "peak memory [GB]", "{:.2f}"),
        ("growth_mb", "growth [MB]", "{:.1f}"),
    )  # fmt: skip
    lines = [[r["figure"], *(show(r.get(key), form) for key, _, form in columns)] for r in found["rows"]]
    busy = f"Load average of the machine at the end: {found['load_average']:.1f} on {found['machine']['cores']} cores."
    return "\n\n".join([markdown(("work", *(title for _, title, _ in columns)), lines), busy])


@entry("cluster-cost")
def _cluster_cost() -> str:
    found, city = read("batches"), read("city_paths")
    sent, rows = found["sent"], {r["figure"]: r for r in found["rows"]}
    lobby = rows["spectra, exact truth, one worker"]["core_ms"] / 1e3
    response = next(r for r in found["rows"] if "gigabytes" in r)
    (plan,) = (v for v in city["verbs"] if "radio_map" in v["verb"])
    width, cell = (float(n) for n in re.findall(r"([0-9]+) m", plan["verb"]))
    work = (
        ("spectra of 60 x 120 pixels, lobby", 1e6, lobby, sent["back_bytes"]),
        ("frequency responses, arrays of 8 x 8 and 4 x 4, 64 frequencies, lobby", 1e6, response["core_ms"] / 1e3,
         1e9 * response["gigabytes"] / response["receivers"]),
        (f"radio map, 10 km wide, cells of {cell:g} m, time of a cell as in Munich", (10e3 / cell) ** 2,
         plan["core_s"] / (width / cell) ** 2, 32.0),
    )  # fmt: skip
    lines = [
        [what, f"{n:.0e}", f"{1e3 * each:.2g} ms", f"{n * each / 3600:.2g} h", f"{n * each / THREADS:.2g} s",
         f"{n * back / 1e9:.2g} GB", f"{n * back / LINK:.2g} s"]
        for what, n, each, back in work
    ]  # fmt: skip
    head = (
        "work", "receivers", "core time each", "all on one core", f"all on {THREADS} threads", "results to the client",
        "time on its link",
    )  # fmt: skip
    once = (
        f"Sent to the workers: {sent['once_bytes'] / 1e6:.1f} MB to each worker once (the lobby's field), and "
        f"{sent['part_bytes'] / 1e3:.1f} kB with each part of {sent['part_receivers']} receivers, which makes "
        f"{1e6 / sent['part_receivers'] * sent['part_bytes'] / 1e6:.0f} MB for a million receivers."
    )
    return "\n\n".join([markdown(head, lines), once])


@entry("benchmarks")
def _benchmarks() -> str:
    from benchmarks.__main__ import NAMES as commands

    return markdown(
        ("`python -m benchmarks`", ""), [(f"`{name}`", line) for name, (_, line) in commands.items()]
    )
