"""Scenes in mesh files: what materials are by name, and fields that need no more."""

import numpy as np
import pytest
import trimesh
from model_files import obj_with_materials, room_glb
from radio_scenes import box_mesh, object_faces

import warprrf as wr

CARRIER = 60e9


def test_materials_of_a_mesh_file_are_known_by_name(tmp_path):
    scene = wr.Scene.load(room_glb(tmp_path))
    assert set(scene.object_names) == {"room", "table", "other table"}
    values = {material.name: material for material in scene.materials}
    assert values["itu_concrete"].itu == "concrete" and values["Wood_01"].itu == "wood"
    faces = object_faces(scene, "other table")
    assert {scene.materials[k].name for k in scene.face_material[faces]} == {"Wood_01"}
    assert scene.mesh.face_colours is not None


def test_names_that_nobody_knows_load_and_are_named_where_values_are_needed(tmp_path):
    path = obj_with_materials(tmp_path)
    path.write_text(path.read_text().replace("Wood_01", "Bark"))
    (tmp_path / "square.mtl").write_text("newmtl Bark\nnewmtl Paint\n")
    scene = wr.Scene.load(path)
    ends = {"transmitter": [0.3, 0.3, 1.0], "receivers": [[0.6, 0.4, 1.2]], "frequency_hz": CARRIER}
    with pytest.raises(
        ValueError, match=r"materials: nothing is known of 'Bark', 'Paint' but the name.*Scene\.load"
    ):
        wr.simulate(scene, shape=(12, 24), **ends)
    with pytest.raises(ValueError, match="'Bark', 'Paint'"):
        wr.trace_paths(scene, **ends)
    paint = wr.em.itu_material("plasterboard")
    with pytest.raises(ValueError, match="materials: nothing is known of 'Bark' but"):
        wr.simulate(wr.Scene.load(path, materials={"Paint": paint}), shape=(12, 24), **ends)
    known = wr.Scene.load(path, materials={"Paint": paint, "Bark": wr.em.itu_material("wood")})
    assert len(wr.simulate(known, shape=(12, 24), **ends)) == 1
    with pytest.raises(ValueError, match="materials: got 'Glass', of which nothing"):
        wr.Scene.load(path, materials={"Glass": paint})


def test_units_belong_to_mesh_files_alone():
    from places import LOBBY

    with pytest.raises(ValueError, match=r"unit, up, simplify: .*scene\.xml is no mesh file"):
        wr.Scene.load(LOBBY / "scene.xml", unit="mm")


def painted_room(folder, named):
    """A room of 5 x 4 x 3 m and a block in it, by material or by colour of vertices."""
    parts = []
    for low, high, inward, colour in (
        ((0, 0, 0), (5, 4, 3), True, (200, 190, 180, 255)), ((2.2, 1.2, 0.01), (3.0, 2.8, 2.6), False, (60, 90, 30, 255)),
    ):  # fmt: skip
        part = trimesh.Trimesh(*box_mesh(low, high, inward=inward), process=False)
        part.visual.vertex_colors = np.tile(colour, (len(part.vertices), 1))
        parts.append(part)
    if not named:
        trimesh.util.concatenate(parts).export(folder / "room.ply")
        return folder / "room.ply"
    scene = trimesh.Scene()
    for name, part in zip(("plaster", "moss"), parts, strict=True):
        part.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(name=name))
        scene.add_geometry(part, node_name=name)
    scene.export(folder / "room.glb")
    return folder / "room.glb"


@pytest.mark.parametrize("named", [True, False])
def test_a_field_is_fitted_to_what_a_mesh_file_tells_apart(named, tmp_path):
    from warprrf.rf.tracing.surface import Surface

    path = painted_room(tmp_path, named)
    mesh, scene = wr.Mesh.load(path, up="z"), wr.Scene.load(path, up="z")
    middle = mesh.triangles.mean(axis=1)
    block = ((middle > [2.1, 1.1, -1]) & (middle < [3.1, 2.9, 2.9])).all(axis=1)
    for geometry in (mesh, scene, wr.Reconstruction.from_files(mesh=mesh)):
        surface = Surface.of(geometry)
        face = mesh.closest(surface.mesh.triangles.mean(axis=1)).face
        of_block, of_walls = (set(surface.material[surface.group[block[face] == k]]) for k in (True, False))
        assert of_block and of_walls and not of_block & of_walls


def test_a_reconstruction_of_a_mesh_alone_saves_loads_and_fits(tmp_path):
    rec = wr.Reconstruction.from_files(mesh=painted_room(tmp_path, named=False))
    rec.save(tmp_path / "kept")
    back = wr.Reconstruction.load(tmp_path / "kept")
    assert not back.has_gaussians and back.has_mesh and "no Gaussians" in repr(back)
    with pytest.raises(ValueError, match=r"has no Gaussians.*from_files a ply="):
        back.gaussians  # noqa: B018
    with pytest.raises(ValueError, match="ply, mesh: got neither"):
        wr.Reconstruction.from_files()
    scene = wr.Scene(
        back.mesh, [wr.Material.custom("wall", relative_permittivity=4.0, scattering=0.5)], np.zeros(24, int)
    )
    ds = wr.simulate(
        scene, transmitter=[0.8, 0.9, 2.2], receivers=[[4.2, 3.1, 1.2], [4.0, 0.8, 1.5]], frequency_hz=CARRIER,
        shape=(12, 24), beam_sigma_rad=0.2,
    )  # fmt: skip
    field = wr.RadioField.fit(back, ds, quick=True)
    assert np.isfinite(field.spectrum(ds.receivers[0]).path_gain).all()
