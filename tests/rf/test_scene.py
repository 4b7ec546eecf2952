"""Scenes: the XML's objects and materials face by face, errors that name what is missing, points in free air."""

import shutil

import numpy as np
import pytest
from places import LOBBY
from radio_scenes import object_faces

from warprrf import cli
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.mesh_files import read_mesh
from warprrf.rf.em.materials import Material
from warprrf.rf.scene import Scene


@pytest.fixture
def copy(tmp_path):
    for name in ("scene.xml", "materials.json"):
        shutil.copy(LOBBY / name, tmp_path)
    shutil.copytree(LOBBY / "meshes", tmp_path / "meshes")
    return tmp_path


@pytest.fixture(scope="module")
def lobby():
    return Scene.load(LOBBY / "scene.xml")


def test_each_face_has_the_material_of_its_object(lobby):
    expected = {"floor": "marble", "wall_west": "glass", "gallery": "concrete", "elevator": "metal"}
    for name, material in expected.items():
        used = {lobby.materials[k].name for k in lobby.face_material[object_faces(lobby, name)]}
        assert used == {material}
    assert len(lobby.face_object) == len(lobby.mesh.faces) == len(lobby.face_material)
    part = read_mesh(LOBBY / "meshes" / "kiosk.ply")
    corners = lobby.mesh.vertices[lobby.mesh.faces[object_faces(lobby, "kiosk")]]
    np.testing.assert_array_equal(corners, part.vertices[part.faces])


def test_air_is_free_and_solids_are_not(lobby):
    points = np.array([[7.3, 5.0, 1.5], [9.2, 3.0, 1.5], [3.6, 3.3, 1.0], [7.5, 6.0, -0.1], [7.5, 6.0, 6.0]])
    np.testing.assert_array_equal(lobby.is_free(points), [True, False, False, False, False])
    behind = np.array([[-0.08, 1.38, 0.6]])  # in the west wall, 6 cm from where the sofa ends within it
    np.testing.assert_array_equal(lobby.is_free(behind), [False])
    near = np.array([[6.3 + 0.29, 2.0, 1.5], [6.3 + 0.31, 2.0, 1.5]])  # 0.29 and 0.31 m east of the partition
    np.testing.assert_array_equal(lobby.is_free(near, clearance_m=0.3), [False, True])


def test_missing_files_and_materials_are_named(copy):
    (copy / "meshes" / "desk.ply").rename(copy / "desk.ply")
    with pytest.raises(FileNotFoundError, match=r"'desk'.*desk\.ply"):
        Scene.load(copy / "scene.xml")
    (copy / "desk.ply").rename(copy / "meshes" / "desk.ply")
    text = (copy / "scene.xml").read_text()
    (copy / "scene.xml").write_text(text.replace("mat-itu_brick", "mat-itu_cheese"))
    with pytest.raises(ValueError, match=r"'wall_north'.*'cheese'.*brick"):
        Scene.load(copy / "scene.xml")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("face_material", [0.4]),
        ("face_material", [-1]),
        ("face_material", [1]),
        ("face_material", [0, 0]),
        ("face_object", [1]),
        ("object_names", "object"),
        ("object_names", ["a", "a"]),
    ],
)
def test_a_scene_of_what_does_not_match_is_refused(name, value):
    wall = Mesh([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 1, 2]])
    with pytest.raises((ValueError, TypeError), match=f"^{name}: got"):
        Scene(**({"mesh": wall, "materials": [Material.conductor()], "face_material": [0]} | {name: value}))


def test_other_materials_are_materials_one_for_each(lobby):
    for wrong in (["marble"] * len(lobby.materials), lobby.materials[:-1]):
        with pytest.raises((ValueError, TypeError), match="^materials"):
            lobby.with_materials(wrong)


@pytest.mark.parametrize("how", ["absolute", "upward", "link", "folder that is a link"])
def test_meshes_outside_the_scenes_folder_are_read_on_request_alone(how, copy, tmp_path_factory):
    away = tmp_path_factory.mktemp("away")
    desk = (copy / "meshes" / "desk.ply").rename(away / "desk.ply")
    names = {"absolute": str(desk), "upward": f"../{away.name}/desk.ply", "link": "meshes/desk.ply"}
    if how == "link":
        (copy / "meshes" / "desk.ply").symlink_to(desk)
    elif how == "folder that is a link":
        (copy / "linked").symlink_to(away)
    text = (copy / "scene.xml").read_text()
    (copy / "scene.xml").write_text(text.replace("meshes/desk.ply", names.get(how, "linked/desk.ply")))
    with pytest.raises(ValueError, match=r"'desk'.*outside.*allow_outside=True"):
        Scene.load(copy / "scene.xml")
    assert "desk" in Scene.load(copy / "scene.xml", allow_outside=True).object_names
    words = [str(copy / "scene.xml"), "-o", str(away / "one.nc"), "--transmitter", "2", "3", "3.2", "--quiet"]
    words += ["--receivers", "7,4,1.5", "--shape", "6", "12"]
    assert cli.main(["simulate", *words]) == 2
    assert cli.main(["simulate", *words, "--allow-outside"]) == 0


def test_a_scene_whose_folder_is_a_link_is_read(copy, tmp_path_factory):
    link = tmp_path_factory.mktemp("links") / "room"
    link.symlink_to(copy)
    assert "desk" in Scene.load(link / "scene.xml").object_names


def test_a_scene_keeps_what_it_was_made_of(lobby):
    """Scenes of a series are often made of one array that is changed in between."""
    material, thing = np.zeros((2, len(lobby.mesh.faces)), np.int32)
    at = np.ones(3)
    scene = Scene(
        lobby.mesh,
        lobby.materials,
        material,
        face_object=thing,
        object_names=("a", "b"),
        transmitters={"t": at},
    )
    for own in (material, thing, at):
        own += 1
    assert not scene.face_material.any() and not scene.face_object.any()
    assert (scene.transmitters["t"] == 1).all()
