"""The viewer's speed: from a drag to its answer, in this process and in a real browser, and whether anything grows."""

from __future__ import annotations

import io
import resource
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.machine import machine
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import require

HELP = """\
Opens what `make lobby` made in the viewer, moves the receiver along a line and says how long each answer takes: spectrum
and paths, computed and sent. With Chromium and its driver installed it also says how long the browser takes to show it,
and takes the pictures of the documentation.

examples:
  python -m benchmarks view --things runs/lobby data/lobby/spectra.nc
"""
FLAGS = (
    "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--window-size=1300,900",
)  # fmt: skip
LINE = np.array([[4.0, 4.5, 1.5], [11.0, 4.0, 1.5]])  # that the receiver is moved along, past a wall's end
FRAMES = 16
COLUMNS = (("figure", "figure", "{}"), ("value", "value", "{:.1f}"))


@dataclass(frozen=True)
class Options:
    """Options of the measurement.

    Attributes:
        things: what is shown: files or folders.
        updates: moves of the receiver.
        pictures: folder for a picture and a clip; none by default.
    """

    things: tuple[str, ...] = option(("runs/lobby", "data/lobby/spectra.nc"), "what is shown")
    updates: int = option(1000, "moves of the receiver")
    pictures: str | None = option(None, "folder for a picture and a clip of the page")


def run(options: Options, job: Job) -> Report:
    """Move the receiver, time the answers.

    Raises:
        ValueError: if what is shown has no field.
    """
    viewer = wr.view(*options.things, port=8765)
    try:
        figures = _timed(viewer, options.updates, job)
        with _browser(viewer.url) as page:
            if page is not None:
                figures |= _browsed(viewer, page, options, job)
    finally:
        viewer.close()
    figures["machine"] = machine(job.device)
    rows = [
        {"figure": name.replace("_", " "), "value": value}
        for name, value in figures.items()
        if name != "machine"
    ]
    return Report("view", figures, columns_table(COLUMNS, rows))


def _timed(viewer: Any, updates: int, job: Job) -> dict[str, Any]:
    def move(count: int) -> None:
        for k, share in enumerate(np.linspace(0.0, 1.0, count)):
            viewer.receiver = LINE[0] + share * (LINE[1] - LINE[0])
            viewer.wait()
            job.progress("moves", k + 1, count)

    move(50)
    if viewer.last is None or viewer.last.spectrum is None:
        raise ValueError("things: got none that answers with a spectrum, expected a field among them")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    viewer.times.clear()
    move(updates)
    times = 1e3 * np.array(viewer.times)
    return {
        "updates": updates, "answer_median_ms": float(np.median(times)), "answer_p90_ms": float(np.percentile(times, 90)),
        "memory_growth_mb": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0,
    }  # fmt: skip


@contextmanager
def _browser(url: str) -> Iterator[Any]:
    """Chromium without a window at ``url``; None where it is not installed."""
    if shutil.which("chromium") is None or shutil.which("chromedriver") is None:
        yield None
        return
    webdriver = require("selenium.webdriver", extra="test")
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for flag in FLAGS:
        options.add_argument(flag)
    page = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    try:
        page.get(url)
        yield page
    finally:
        page.quit()


def _browsed(viewer: Any, page: Any, options: Options, job: Job) -> dict[str, Any]:
    """How long the browser takes from an answer to a frame that shows it, drawn in software; and pictures."""
    start = time.perf_counter()
    while not viewer.clients:
        time.sleep(0.1)
    opened = time.perf_counter() - start
    (client,) = viewer.clients
    client.get_render(300, 400)
    page.execute_script(
        "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
    )
    times, frames = [], []
    for k, share in enumerate(np.linspace(0.0, 1.0, FRAMES)):
        viewer.receiver = LINE[0] + share * (LINE[1] - LINE[0])
        viewer.wait()
        start = time.perf_counter()
        client.get_render(300, 400)
        times.append(1e3 * (time.perf_counter() - start))
        if options.pictures is not None:
            time.sleep(1.0)
            frames.append(_picture(page))
        job.progress("browser", k + 1, FRAMES)
    if options.pictures is not None:
        viewer.receiver = _held_out(viewer)
        viewer.wait()
        time.sleep(10.0)
        _save(_picture(page), frames, Path(options.pictures))
    return {"page_opens_s": opened, "browser_frame_median_ms": float(np.median(times))}


def _picture(page: Any, tries: int = 6) -> bytes:
    """The page as a PNG; a busy machine may take longer for a frame than the driver waits."""
    timed_out = require("selenium.common.exceptions", extra="test").TimeoutException
    for _ in range(tries - 1):
        with suppress(timed_out):
            return page.get_screenshot_as_png()
    return page.get_screenshot_as_png()


def _held_out(viewer: Any) -> np.ndarray:
    """The measured place nearest to the middle of the line that the field was not fitted to, or else the middle."""
    middle, ds = LINE.mean(axis=0), viewer.subject.spectra
    free = [] if ds is None else ds.receivers[~viewer.subject.field.was_fitted_on(ds)]
    return min(free, key=lambda place: float(np.linalg.norm(place - middle)), default=middle)


def _save(still: bytes, frames: list[bytes], folder: Path) -> None:
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    Image.open(io.BytesIO(still)).convert("RGB").save(folder / "viewer.png", optimize=True)
    pictures = [Image.open(io.BytesIO(frame)).convert("RGB") for frame in frames]
    small = [p.resize((p.width // 2, p.height // 2), Image.Resampling.LANCZOS) for p in pictures]
    small[0].save(
        folder / "viewer.webp", save_all=True, append_images=small[1:], duration=250, loop=0, quality=60
    )


BENCHMARKS = {"view": Benchmark("view", Options, run, HELP)}
