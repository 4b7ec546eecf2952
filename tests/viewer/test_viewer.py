"""The page in a real browser: it opens, what is dragged is answered, and nothing grows."""

import dataclasses
import io
import re
import resource
import shutil
import socket
import time
from contextlib import contextmanager

import numpy as np
import pytest
import trimesh
from golden import make
from PIL import Image
from scipy.spatial.transform import Rotation
from selenium import webdriver
from selenium.common.exceptions import TimeoutException
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By

import warprrf as wr
from warprrf import cli
from warprrf.cache import Cache
from warprrf.viewer import answers

CHROMIUM = (shutil.which("chromium"), shutil.which("chromedriver"))
NEEDED = "needs Chromium and its driver (apt: chromium chromium-driver)"
browsed = pytest.mark.skipif(None in CHROMIUM, reason=NEEDED)
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
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM[0]
    for flag in FLAGS:
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(CHROMIUM[1]))
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


@contextmanager
def _beside(page, address):
    """Another page, in a tab of its own."""
    here = page.current_window_handle
    page.switch_to.new_window("tab")
    page.get(address)
    yield
    page.close()
    page.switch_to.window(here)


@pytest.fixture
def found(viewer):
    """The answer at ``RECEIVER``."""
    viewer.receiver = RECEIVER
    return viewer.wait()


def _survey(viewer, ask):
    """The viewer's survey, when it has done what ``ask`` names."""
    getattr(viewer._survey, ask)()
    viewer._page.wait()
    return viewer._survey


def _picture(page):
    """The page's canvas and panel as colours (H, W, 3)."""
    return np.asarray(Image.open(io.BytesIO(page.get_screenshot_as_png())).convert("RGB"), dtype=float)


def _panel(page):
    """The right part of the page, where spectrum and figures are."""
    whole = _picture(page)
    return whole[:, -int(0.25 * whole.shape[1]) :]


def test_moving_the_receiver_answers_for_where_it_is(viewer):
    viewer.receiver = [1000.0, 0.0, 0.0]
    assert viewer.wait() is None and "outside the scene" in viewer.message
    viewer.receiver = RECEIVER
    found = viewer.wait()
    np.testing.assert_array_equal(found.receiver, RECEIVER)
    assert "path gain" in viewer.message and found.spectrum.total_path_gain > 0


def test_a_scene_far_from_zero_is_drawn_as_one_at_zero():
    """Browsers draw in single precision, whose steps are half a metre in a country's coordinates."""
    drawn, (mesh, _), ds = [], make.room_mesh(), make.spectra()
    for off in np.zeros(3), np.array([5e5, 5e6, 0.0]):
        places = make.TRANSMITTER + off, ds.receivers + off
        readings = wr.Readings(*places, np.full(len(ds), 1e-9), make.CARRIER_HZ, 1e-20)
        viewer = wr.view(wr.Mesh(mesh.vertices + off, mesh.faces), readings, port=8190)
        try:
            viewer.receiver = RECEIVER + off
            np.testing.assert_allclose(viewer.wait().receiver, RECEIVER + off, rtol=0, atol=1e-8)
            named = viewer._page.scene.get_handle_by_name
            room = trimesh.load(io.BytesIO(named("/mesh").glb_data), file_type="glb").bounds
            at = named("/receiver").position, named("/paths/chosen/figures").position
            drawn.append([named("/paths").points, named("/measured").batched_positions, room, *at])
        finally:
            viewer.close()
    for near, far in zip(*drawn, strict=True):
        np.testing.assert_allclose(far, near, atol=1e-4)


def test_where_nothing_arrives_no_gain_is_made_up(tmp_path, capsys):
    dark = dataclasses.replace(
        make.bistatic(),
        effects=wr.Effects(mirrors=0, scatterings=0, transmissions=0, diffractions=0, residual=False),
    )
    place = next(p for p in make.places(40) if dark.links(p).total_path_gain == 0.0)
    asked = answers.Asked(dark.frequency_hz, 0, 0, 0)
    assert answers.answer(dark, place, [dark.transmitter], asked).total_db == -np.inf
    viewer = wr.view(make.room_mesh()[0], dark, port=8194)
    try:
        viewer.receiver = place
        viewer.wait()
        assert "nothing arrives" in viewer.message.replace("*", "")
        assert np.isnan(viewer._channel._profile.data[1]).all()
    finally:
        viewer.close()
    dark.save(tmp_path / "dark.safetensors")
    words = [
        "render",
        str(tmp_path / "dark.safetensors"),
        "--receiver",
        *map(str, place),
        "-o",
        str(tmp_path / "s.npz"),
    ]
    assert cli.main([*words, "--json"]) == 0
    assert '"total_path_gain_db": null' in capsys.readouterr().out  # as those of a map


def test_what_is_shown_is_saved_as_one_page_and_as_a_picture(viewer, tmp_path):
    viewer.save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert page.count("data:image/png;base64,") >= 1 and "path gain" in page and 'src="http' not in page
    viewer.save(tmp_path / "spectrum.png")
    assert (tmp_path / "spectrum.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match=r"path: got .*expected a name that ends in .html or .png"):
        viewer.save(tmp_path / "scene.obj")


def test_an_address_that_is_none_is_refused():
    for name, value in (("host", "192.0.2.1"), ("host", ""), ("port", 0), ("port", 2.5)):
        with pytest.raises((ValueError, TypeError), match=f"{name}: got {value!r}"):
            wr.view(make.room_mesh()[0], **{name: value})


def test_a_port_that_is_taken_without_a_free_one_above_it_is_refused():
    with (
        socket.create_server(("127.0.0.1", 65535)),
        pytest.raises(ValueError, match="port: got 65535, which"),
    ):
        wr.view(make.room_mesh()[0], port=65535)


def test_spherical_cameras_are_drawn():
    camera = wr.Camera.spherical(8, 4, position=RECEIVER)
    viewer = wr.view(wr.Reconstruction(None, make.room_mesh()[0], {"a.jpg": camera}), port=8193)
    try:
        drawn = viewer._page.scene.get_handle_by_name("/cameras/a.jpg")
        np.testing.assert_allclose(drawn.position, RECEIVER)
        assert 0.5 < drawn.fov < 2.0
    finally:
        viewer.close()


def test_errors_at_measured_places_are_listed_worst_first(viewer):
    ds, field = viewer.subject.spectra, viewer.subject.field
    wanted = [answers.errors(field.spectrum(r), ds[k])["psnr_db"] for k, r in enumerate(ds.receivers)]
    listed = [float(button.label.split()[0]) for button in _survey(viewer, "errors").listed]
    np.testing.assert_allclose(listed, np.sort(wanted)[: len(listed)], atol=0.06)


def test_what_was_not_read_is_no_error_to_list(viewer):
    field, ds = viewer.subject.field, viewer.subject.spectra
    power = np.array([1e-10, np.nan, 1e-12])
    readings = wr.Readings(field.transmitter, ds.receivers[:3], power, field.frequency_hz, 1e-20)
    viewer._survey._reading_errors(readings, field, None)
    assert [button.label.split(" dB at")[0][-1].isdigit() for button in viewer._survey.listed] == [True, True]


def test_at_another_carrier_fields_are_carried_over_and_not_compared_with_what_was_measured(viewer):
    viewer.receiver = viewer.subject.spectra.receivers[0]
    viewer.wait()
    assert [image[0] for image in viewer._channel.images] == ["spectrum", "truth", "spectrum less truth"]
    viewer._channel.carrier.value = 140.0
    assert viewer.wait().frequency_hz == 140e9 and "carried over to 140 GHz" in viewer.message
    assert [image[0] for image in viewer._channel.images] == ["spectrum"]
    _survey(viewer, "errors")
    assert f"expected that of what was measured, {make.CARRIER_HZ / 1e9:g} GHz" in viewer.message
    viewer._channel.carrier.value = make.CARRIER_HZ / 1e9
    assert viewer.wait().frequency_hz == make.CARRIER_HZ and "carried over" not in viewer.message


def test_what_was_measured_under_another_transmitter_is_not_compared_with(viewer, monkeypatch):
    ds, field = viewer.subject.spectra, viewer.subject.field
    viewer.receiver, other = ds.receivers[0], ds.transmitter + [0.4, 0.9, -0.3]
    viewer._transmitters[0].position = other
    viewer.refresh()
    viewer.wait()
    assert [image[0] for image in viewer._channel.images] == ["spectrum"]
    assert "one transmitter at 1.10, 1.30, 2.40 m" in viewer._channel.spectra.content
    viewer._transmitters[0].position = ds.transmitter
    viewer.refresh()
    viewer.wait()
    assert [image[0] for image in viewer._channel.images][1:] == ["truth", "spectrum less truth"]
    wanted = [float(button.label.split()[0]) for button in _survey(viewer, "errors").listed]
    monkeypatch.setattr(viewer, "_fields", Cache(1))
    monkeypatch.setattr(viewer.subject, "field", dataclasses.replace(field, transmitter=other))
    assert [float(button.label.split()[0]) for button in _survey(viewer, "errors").listed] == wanted


def test_the_map_lies_on_the_floor_with_its_scale(viewer):
    viewer._survey.height.value = 1000.0
    _survey(viewer, "map")
    assert "height: got 1000.0 m" in viewer.message
    viewer._survey.height.value = 1.5
    _survey(viewer, "map")
    handle = viewer._page.scene.get_handle_by_name("/map")
    assert handle.position[2] == pytest.approx(0.03, abs=1e-4), viewer.message
    low, high = viewer.subject.mesh.bounds
    np.testing.assert_allclose(handle.position[:2], 0.5 * (low + high)[:2], atol=0.5)
    assert "total path gain [dB] at " in viewer._survey.legend.content


def test_a_map_with_places_that_nothing_reaches_has_its_scale(viewer, monkeypatch):
    dark = dataclasses.replace(
        viewer.subject.field,
        effects=wr.Effects(mirrors=0, scatterings=0, transmissions=0, diffractions=0, residual=False),
    )
    monkeypatch.setattr(viewer, "_fields", Cache(1))
    monkeypatch.setattr(viewer.subject, "field", dark)
    viewer._survey.height.value = 1.5
    gain = dark.radio_map(1.5, 0.5).total_path_gain
    assert (gain == 0.0).any() and (gain > 0.0).any()
    _survey(viewer, "map")
    low = 10.0 * np.log10(np.percentile(gain[gain > 0.0], 2.0, method="lower"))
    high = 10.0 * np.log10(np.percentile(gain[gain > 0.0], 2.0, method="higher"))
    shown = re.search(r"<span>(\S+) </span>", viewer._survey.legend.content)
    assert low - 0.05 <= float(shown[1]) <= high + 0.05


def test_places_to_measure_next_are_those_that_the_field_suggests(viewer):
    survey, field = _survey(viewer, "suggest"), viewer.subject.field
    assert len(survey.listed) == 3, viewer.message
    first = np.array([float(x) for x in survey.listed[0].label[5:-2].split(",")])
    places = survey.candidates(field)
    np.testing.assert_allclose(first, places[field.suggest(places, 1)[0]], atol=0.006)


def test_a_click_on_a_path_chooses_it_and_one_beside_all_does_not(viewer, found):
    listed, rays = answers.strongest(found.paths, 5), viewer._rays
    kind = [str(p.kind[k]) for p, k in listed]
    assert kind[0] == "los" and rays.label.startswith("los ")
    mirror = kind.index("mirror")
    leg = answers.legs(*listed[mirror])[0]
    eye = np.array([2.0, 0.5, 9.0])
    rays.click(eye, np.array([0.0, 0.0, 1.0]))
    assert rays.label.startswith("los ")
    rays.click(eye, 0.4 * leg[0] + 0.6 * leg[1] - eye)
    assert rays.label.startswith("mirror ") and answers.described(*listed[mirror])[1] in rays.label


@browsed
def test_a_notebook_shows_the_page(viewer, page, tmp_path):
    from IPython.core.formatters import DisplayFormatter

    shown = DisplayFormatter().format(viewer)[0]["text/html"]
    assert viewer.url in shown and viewer.url.startswith("http://127.0.0.1:")
    (tmp_path / "cell.html").write_text(shown)
    before = len(viewer.clients)
    with _beside(page, f"file://{tmp_path / 'cell.html'}"):
        _until(lambda: len(viewer.clients) == before + 1, 60)
    _until(lambda: len(viewer.clients) == before, 60)


@browsed
def test_pointing_at_a_ring_in_the_spectrum_tells_its_path(found, page):
    (paths,) = found.paths
    kind, gain, delay, *_ = answers.described(paths, int(paths.power.argmax()))
    _until(lambda: page.find_elements(By.CSS_SELECTOR, ".wr .mark"), 60)
    time.sleep(1)  # the last drag's figures are replaced by these
    ring, tip = (page.find_elements(By.CSS_SELECTOR, f".wr .{name}")[0] for name in ("mark", "tip"))
    assert not tip.is_displayed()
    ActionChains(page).move_to_element(ring).perform()
    _until(tip.is_displayed, 10)
    assert tip.text.startswith(f"{kind}: {gain}, {delay}")


@browsed
def test_a_saved_page_shows_the_room_and_its_figures_without_a_server(viewer, found, page, tmp_path):
    def drawn():
        try:
            return _picture(page)[:, : page.get_window_size()["width"] // 2].std() > 5.0
        except TimeoutException:  # a busy machine draws its first frame in software for many seconds
            return False

    viewer.save(tmp_path / "page.html")
    with _beside(page, f"file://{tmp_path / 'page.html'}"):
        _until(lambda: page.find_elements(By.TAG_NAME, "canvas"), 60)
        _until(drawn, 120)
        assert "path gain" in page.find_element(By.CSS_SELECTOR, "p.wr").text
        assert page.find_element(By.CSS_SELECTOR, ".wr img").get_property("naturalWidth") == make.SHAPE[1]


@browsed
def test_share_gives_the_browser_the_page_and_the_picture_as_files(viewer, page, tmp_path):
    page.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    _click(page, "Share")
    for label, name, start in (
        ("page (.html)", "warprrf.html", b"<!DOCTYPE html"),
        ("picture (.png)", "warprrf.png", b"\x89PNG"),
    ):
        _click(page, label)
        _until((tmp_path / name).is_file, 60)
        found = (tmp_path / name).read_bytes()
        assert found[:14].upper().startswith(start.upper()) and len(found) > 10_000
    _click(page, "Channel")


@browsed
def test_a_drag_in_the_browser_changes_spectrum_and_picture(viewer, found, page):
    time.sleep(3)
    before, start = _panel(page), viewer.receiver
    x, y = _pixel(viewer, page, viewer.receiver + [0.35, 0.0, 0.0])  # the arrow along x
    held = _at(page, x, y).click_and_hold()
    held.move_by_offset(40, 0).pause(0.3).move_by_offset(20, 0).release().perform()
    _until(lambda: not np.allclose(viewer.receiver, start), 30)
    found = viewer.wait()
    np.testing.assert_array_equal(found.receiver, viewer.receiver)
    _until(lambda: np.abs(_panel(page) - before).mean() > 1.0, 30)  # another spectrum, other figures


@browsed
def test_a_click_in_the_browser_chooses_the_path_under_it(viewer, found, page):
    listed = answers.strongest(found.paths, 5)
    time.sleep(2)
    assert viewer._rays.label.startswith("los ")
    paths, k = next(path for path in listed if path[0].kind[path[1]] == "mirror")
    leg = answers.legs(paths, k)[0]
    _at(page, *_pixel(viewer, page, 0.3 * leg[0] + 0.7 * leg[1])).click().perform()
    _until(lambda: answers.described(paths, k)[1] in viewer._rays.label, 30)


@pytest.fixture(scope="module")
def table(viewer, tmp_path_factory):
    """What a horn of 20 degrees reads at ``RECEIVER``, as a CSV file that says it stood elsewhere."""
    angles = [(e, a) for e in (-40.0, 0.0, 40.0) for a in np.arange(-180.0, 180.0, 15.0)]
    up, around = np.radians(angles).T
    toward = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=1)
    field = viewer.subject.field
    paths = field.paths(RECEIVER)
    off = np.arccos(np.clip(toward @ paths.arrival.T, -1.0, 1.0))
    power_db = 10.0 * np.log10(wr.horn(np.radians(20.0)).gain_off_boresight(off) @ paths.power)
    ends = ",".join(str(x) for x in [*field.transmitter, 1.0, 1.0, 1.0])
    lines = ["tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,elevation_deg,azimuth_deg,power_db"]
    lines += [f"{ends},{e},{a},{power:.2f}" for (e, a), power in zip(angles, power_db, strict=True)]
    file = tmp_path_factory.mktemp("table") / "horn <20>.csv"
    file.write_text("\n".join(lines))
    return file


@browsed
def test_a_table_given_to_the_page_puts_the_receiver_where_it_was_read(viewer, page, table):
    """Through the browser's own choice of a file; what is no table is said to be none, and moves nothing."""
    survey, start = viewer._survey, viewer.receiver
    survey._width_deg.value, survey._floor_db.value = 20.0, -200.0
    _click(page, "Survey")
    (given,) = page.find_elements(By.CSS_SELECTOR, "input[type=file]")
    wrong = table.with_name("wrong.csv")
    wrong.write_text("a,b\n1,2\n")
    given.send_keys(str(wrong))
    _until(lambda: "lacks the columns" in viewer.message, 60)
    np.testing.assert_array_equal(viewer.receiver, start)
    given.send_keys(str(table))
    _until(lambda: "horn &lt;20&gt;.csv: at " in survey.legend.content, 300)
    viewer.wait()
    assert np.linalg.norm(viewer.receiver - RECEIVER) < 0.1, survey.legend.content
    assert survey.listed[0].label.startswith("likely by ")
    _click(page, "Channel")


@pytest.mark.long
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


def _at(page, x, y):
    """The mouse at a pixel, from wherever it was."""
    actions = ActionChains(page)
    actions.w3c_actions.pointer_action.move_to_location(x, y)
    return actions


def _click(page, label):
    """Click the button or tab of that name."""
    path = f"//*[self::button or @role='tab'][normalize-space(.)='{label}']"
    _until(lambda: page.find_elements("xpath", path), 20)
    page.find_element("xpath", path).click()


def _pixel(viewer, page, point):
    """Where ``point`` (3,) is seen, in pixels from the window's corner."""
    (client,) = viewer.clients
    camera = client.camera
    turn = Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix()
    local = turn.T @ (np.asarray(point) - camera.position)
    canvas = page.find_element(By.TAG_NAME, "canvas").rect
    x, y = 0.5 * canvas["height"] / np.tan(0.5 * camera.fov) * local[:2] / local[2]
    return int(canvas["x"] + 0.5 * canvas["width"] + x), int(canvas["y"] + 0.5 * canvas["height"] + y)
