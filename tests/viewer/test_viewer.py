"""The page in a real browser: it opens, what is dragged is answered, and nothing grows."""

import resource
import shutil
import time

import numpy as np
import pytest
from golden import make

import warprrf as wr

CHROMIUM = (shutil.which("chromium"), shutil.which("chromedriver"))
browsed = pytest.mark.skipif(
    None in CHROMIUM, reason="needs Chromium and its driver (apt: chromium chromium-driver)"
)
FLAGS = (
    "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--window-size=1200,800",
)  # fmt: skip
RECEIVER = make.TRANSMITTER + [2.0, 0.3, -1.0]


@pytest.fixture(scope="module")
def viewer():
    (mesh, _), ds = make.room_mesh(), make.spectra()
    viewer = wr.view(mesh, make.bistatic(), ds, port=8123)
    viewer.wait()
    yield viewer
    viewer.close()


@pytest.fixture(scope="module")
def page(viewer):
    from selenium import webdriver
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = CHROMIUM[0]
    for flag in FLAGS:
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options, service=Service(CHROMIUM[1]))
    try:
        driver.get(viewer.url)
        _until(lambda: viewer.clients, 120)
        yield driver
        severe = [e["message"] for e in driver.get_log("browser") if e["level"] == "SEVERE"]
        assert not severe, severe
    finally:
        driver.quit()


def _until(done, seconds):
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, f"nothing within {seconds} s"
        time.sleep(0.2)


def _picture(page):
    """The page's canvas and panel as colours (H, W, 3)."""
    import io

    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(page.get_screenshot_as_png())).convert("RGB"), dtype=float)


def _panel(page):
    """The right part of the page, where spectrum and figures are."""
    whole = _picture(page)
    return whole[:, -int(0.25 * whole.shape[1]) :]


def test_moving_the_receiver_answers_for_where_it_is(viewer):
    viewer.receiver = RECEIVER
    found = viewer.wait()
    np.testing.assert_array_equal(found.receiver, RECEIVER)
    assert "path gain" in viewer.message and found.spectrum.total_path_gain > 0


def test_a_place_in_a_wall_is_said_to_have_no_answer(viewer):
    viewer.receiver = [1000.0, 0.0, 0.0]
    assert viewer.wait() is None and "outside the scene" in viewer.message
    viewer.receiver = RECEIVER
    assert viewer.wait() is not None


def test_what_is_shown_is_saved_as_one_page_and_as_a_picture(viewer, tmp_path):
    viewer.save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert page.count("data:image/png;base64,") >= 1 and "path gain" in page and 'src="http' not in page
    viewer.save(tmp_path / "spectrum.png")
    assert (tmp_path / "spectrum.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match=r"path: got .*expected a name that ends in .html or .png"):
        viewer.save(tmp_path / "scene.obj")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"host": "192.0.2.1"}, "host: got '192.0.2.1'"),
        ({"port": 0}, "port: got 0"),
        ({"port": 2.5}, "port: got 2.5"),
    ],
)
def test_an_address_that_is_none_is_refused(given, said):
    with pytest.raises((ValueError, TypeError), match=said):
        wr.view(make.room_mesh()[0], **given)


def test_a_notebook_shows_the_page(viewer):
    assert viewer.url in viewer._repr_html_() and viewer.url.startswith("http://127.0.0.1:")


@browsed
def test_a_drag_in_the_browser_changes_spectrum_and_picture(viewer, page):
    from selenium.webdriver.common.action_chains import ActionChains

    viewer.receiver = RECEIVER
    viewer.wait()
    time.sleep(3)
    before, start = _panel(page), viewer.receiver
    x, y = _pixel(viewer, page, viewer.receiver + [0.35, 0.0, 0.0])  # the arrow along x
    ActionChains(page).move_by_offset(x, y).click_and_hold().move_by_offset(40, 0).pause(0.3).move_by_offset(
        20, 0
    ).release().perform()
    _until(lambda: not np.allclose(viewer.receiver, start), 30)
    found = viewer.wait()
    np.testing.assert_array_equal(found.receiver, viewer.receiver)
    _until(lambda: np.abs(_panel(page) - before).mean() > 1.0, 30)  # another spectrum, other figures


@browsed
def test_a_thousand_updates_leave_memory_as_it_is(viewer, page):
    rng = np.random.default_rng(0)

    def update(times):
        for step in rng.normal(0.0, 0.05, (times, 3)):
            viewer.receiver = RECEIVER + step
            viewer.wait()

    update(200)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    update(1000)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert grown < 30, f"{grown:.0f} MB more"


def _pixel(viewer, page, point):
    """Where ``point`` (3,) is seen, in pixels from the window's corner."""
    from selenium.webdriver.common.by import By

    (client,) = viewer.clients
    camera = client.camera
    w, x, y, z = camera.wxyz
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    local = turn.T @ (np.asarray(point) - camera.position)
    canvas = page.find_element(By.TAG_NAME, "canvas").rect
    focal = 0.5 * canvas["height"] / np.tan(0.5 * camera.fov)
    return (
        int(canvas["x"] + 0.5 * canvas["width"] + focal * local[0] / local[2]),
        int(canvas["y"] + 0.5 * canvas["height"] + focal * local[1] / local[2]),
    )
