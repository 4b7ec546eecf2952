"""The page of a reconstruction: whole, safe, and its figures by closed form."""

import re
from dataclasses import replace

import numpy as np
import pytest
from radio_scenes import box_mesh, joined
from views import look

import warprrf as wr
from warprrf.geometry.planes import Plane
from warprrf.geometry.report import colours_matched, psnr_db
from warprrf.geometry.report.sight import CLASSES, from_outside, how_seen
from warprrf.geometry.splats.gaussians import discs_on_mesh

image = pytest.importorskip("PIL.Image")
BOX = box_mesh([0, 0, 0], [4, 3, 2.5], inward=True)
ROOM = wr.Mesh(*BOX)


def test_a_surface_is_seen_by_the_cameras_that_look_at_it():
    ahead = look([1.0, 1.5, 1.2], [4.0, 1.5, 1.2], f=1.0)  # nearly all before it
    seen = how_seen(ROOM, [ahead, ahead, ahead])
    on_wall, behind = seen.points[:, 0] > 3.999, seen.points[:, 0] < 0.9
    assert on_wall.sum() > 1000 and (seen.photos[on_wall] == 3).all()
    assert behind.sum() > 1000 and (seen.photos[behind] == 0).all()
    # Spread by area: the wall has 3 x 2.5 of 59 square metres.
    assert on_wall.mean() == pytest.approx(3 * 2.5 / 59, rel=0.05)
    assert seen.shares.sum() == pytest.approx(1.0) and seen.shares[3] == seen.shares[4] == 0.0
    assert [CLASSES[k][0] for k in np.unique(seen.classes)] == [0, 3]


def test_what_no_photo_shows_and_what_only_edges_found_are_told_apart():
    ahead = look([1.0, 1.5, 1.2], [4.0, 1.5, 1.2], f=1.0)
    seen = how_seen(ROOM, [ahead])
    facing, behind = (
        Plane(np.array([-sign, 0, 0.0]), -sign * x, np.zeros(0, dtype=int), occupied=np.ones((99, 99), bool), plain=True)
        for sign, x in ((1, 4.0), (-1, 0.0))
    )  # fmt: skip
    facing, behind = (replace(p, corner=np.array([-5.0, -5.0])) for p in (facing, behind))
    unseen = (seen.photos == 0).mean()
    assert 0.2 < unseen < 0.5
    assert seen.unseen_and_plain([behind]) == (unseen, 0.0)
    assert seen.unseen_and_plain([facing]) == (unseen, pytest.approx(3 * 2.5 / 59, rel=0.05))
    assert seen.unseen_and_plain([replace(facing, plain=False)]) == (unseen, 0.0)


def test_what_stands_before_a_surface_hides_it():
    both, _ = joined(BOX, box_mesh([2, 0, 0], [2.5, 3, 2.5]))
    seen = how_seen(both, [look([1.0, 1.5, 1.2], [4.0, 1.5, 1.2], f=1.0)])
    assert (seen.photos[seen.points[:, 0] > 2.51] == 0).all()


def test_from_outside_one_looks_through_the_backs_of_walls_and_ceiling():
    points, light = from_outside(ROOM, 0.25 * np.pi, width=120)
    met = np.isfinite(points[..., 0])
    assert met.mean() > 0.4 and (light[met] > 0.5).all()
    shown = points[met]
    inner = (np.abs(shown[:, 2]) < 1e-6) | (np.abs(shown[:, 0]) < 1e-6) | (np.abs(shown[:, 1]) < 1e-6)
    assert inner.all()  # the floor and the two walls that face the eye


def test_psnr_and_matched_colours_are_by_definition():
    rng = np.random.default_rng(0)
    photo = rng.uniform(0.2, 0.6, (8, 9, 3))
    assert psnr_db(photo + 0.1, photo) == pytest.approx(20.0)
    mixed = photo @ np.array([[0.9, 0.1, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 1.1]]) + 0.05
    assert psnr_db(colours_matched(mixed, photo), photo) > 100


def test_the_page_needs_nothing_else_and_shows_names_as_text(tmp_path):
    cameras, files = {}, {}
    for k in range(4):
        name = f"<b>{k}&.png"
        cameras[name] = look([1.0 + 0.3 * k, 1.5, 1.2], [4.0, 1.5 + 0.2 * k, 1.0], f=30.0)
        files[name] = tmp_path / f"{k}.png"
        image.fromarray(np.full((48, 64, 3), 40 * k, np.uint8)).save(files[name])
    del files["<b>3&.png"]
    rec = wr.Reconstruction(
        discs_on_mesh(ROOM, 500), ROOM, cameras, metric=False, held_out=["<b>1&.png"], unposed=["dark.jpg"],
        causes={"dark.jpg": "shows 2 features"}, guessed=["scale: 3 m"], photos=files,
    )  # fmt: skip
    rec.save(tmp_path / "room")
    wr.Reconstruction.load(tmp_path / "room").report(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<b>" not in page and "&lt;b&gt;1&amp;.png" in page
    assert set(re.findall(r'src="([^,]*),', page)) == {"data:image/jpeg;base64"} and "href" not in page
    assert page.count("<img") == 2 + 4 + 4 and page.count("<circle") == 4
    told = "4 of 5 posed; dark.jpg; shows 2 features; scale: 3 m; 64 x 48; dB with colours matched"
    assert [text for text in told.split("; ") if text not in page] == []
    for file in files.values():
        file.unlink()
    rec.report(tmp_path / "page.html")
    assert "not there any more" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_mesh_alone_has_a_page_too(tmp_path):
    around = {"a.jpg": wr.Camera.spherical(8, 4, position=(2, 2, 1))}
    wr.Reconstruction(mesh=ROOM, cameras=around).report(tmp_path / "page.html")
    assert "180°" in (tmp_path / "page.html").read_text(encoding="utf-8")
    wr.Reconstruction(mesh=ROOM).report(tmp_path / "page.html")
    assert "from four sides" in (tmp_path / "page.html").read_text(encoding="utf-8")
