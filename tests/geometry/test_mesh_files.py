"""Mesh files of other software: units, axes, instances, colours, names; what they may name; damage."""

import base64
import pickle
from pathlib import Path

import numpy as np
import pytest
import trimesh
from model_files import BLUE, RED, changed_glb, obj_with_materials, room_glb, room_gltf

import warprrf as wr
from warprrf.geometry import gltf_files, mesh_content, obj_files
from warprrf.geometry.mesh_files import load_mesh, read_mesh, write_mesh

BLUE_SRGB = np.array(BLUE) / 255.0


@pytest.mark.parametrize("make", [room_glb, room_gltf])
def test_instances_of_a_gltf_scene_stand_in_their_places_z_up(make, tmp_path):
    mesh = wr.Mesh.load(make(tmp_path))
    # y-up 4 x 3 x 5 becomes 4 wide, 5 deep, 3 high
    np.testing.assert_allclose(mesh.bounds, [[-2, -2.5, -1.5], [2, 2.5, 1.5]], atol=1e-6)
    assert set(mesh.labels) == {"itu_concrete", "Wood_01"}
    wood = np.flatnonzero(mesh.face_label == mesh.labels.index("Wood_01"))
    assert len(wood) == 4
    lowest = mesh.triangles[wood].reshape(2, -1, 3).min(axis=1)
    placed = [[0.2, -0.4, 0.3], [-1.0, 0.0, 0.0]]  # (x, y, z) of the file is (x, -z, y)
    np.testing.assert_allclose(lowest[np.argsort(lowest[:, 0])], np.array(placed)[::-1], atol=1e-6)
    # a mirror turns corners about, and winding with them: both face the file's z
    np.testing.assert_allclose(mesh.face_normals[wood], [[0.0, -1.0, 0.0]] * 4, atol=1e-6)
    np.testing.assert_allclose(mesh.face_colours[wood], [BLUE_SRGB] * 4, atol=1e-3)
    # the factor of a material is linear light
    walls = mesh.face_label == mesh.labels.index("itu_concrete")
    grey = 1.055 * (128 / 255) ** (1 / 2.4) - 0.055
    np.testing.assert_allclose(mesh.face_colours[walls], grey, atol=1e-3)


def test_an_axis_that_is_asked_for_is_taken(tmp_path):
    path = room_glb(tmp_path)
    as_it_stands = wr.Mesh.load(path, up="z").vertices
    np.testing.assert_allclose(np.ptp(as_it_stands, axis=0), [4, 3, 5], atol=1e-6)
    np.testing.assert_allclose(np.ptp(wr.Mesh.load(path, up="x").vertices, axis=0), [3, 5, 4], atol=1e-6)
    for up in "xyz":
        axes = wr.Mesh.load(path, up=up)
        assert np.linalg.det(np.linalg.lstsq(as_it_stands, axes.vertices, rcond=None)[0]) == pytest.approx(1)


def test_objects_of_an_obj_file_keep_material_and_texture(tmp_path):
    content = read_mesh(obj_with_materials(tmp_path))
    np.testing.assert_array_equal(content.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 3]])
    assert content.material_names == ("Wood_01", "Paint") and content.object_names == ("floor", "wall")
    np.testing.assert_array_equal(content.face_material, [0, 0, 1])
    np.testing.assert_allclose(content.face_colours, [BLUE_SRGB, BLUE_SRGB, [0.9, 0.1, 0.2]], atol=1e-3)


def test_names_of_an_obj_file_stay_where_its_materials_are_missing(tmp_path):
    path = obj_with_materials(tmp_path)
    (tmp_path / "square.mtl").unlink()
    with pytest.warns(UserWarning, match=r"square\.obj needs the file 'square\.mtl'"):
        mesh = wr.Mesh.load(path)
    assert mesh.labels == ("Wood_01", "Paint") and mesh.face_colours is None


@pytest.mark.parametrize(
    ("unit", "metres"), [("mm", 0.001), ("cm", 0.01), ("m", 1), ("in", 0.0254), ("ft", 0.3048)]
)
@pytest.mark.parametrize("encoding", ["stl", "stl_ascii"])
def test_units_are_metres_afterwards(unit, metres, encoding, tmp_path):
    trimesh.creation.box((40.0, 30.0, 25.0)).export(tmp_path / "box.stl", file_type=encoding)
    mesh = wr.Mesh.load(tmp_path / "box.stl", unit=unit)
    np.testing.assert_allclose(np.ptp(mesh.bounds, axis=0), np.array([40, 30, 25]) * metres)
    assert len(mesh.vertices) == 8 and mesh.is_closed  # STL stores 36


def test_a_room_in_millimetres_taken_for_metres_is_said(tmp_path):
    trimesh.creation.box((9000.0, 5000.0, 2500.0)).export(tmp_path / "box.stl")
    with pytest.warns(UserWarning, match=r"box\.stl is 9e\+03 m in size.*unit="):
        wr.Mesh.load(tmp_path / "box.stl")


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_colours_of_ply_vertices_are_those_of_faces(encoding, tmp_path):
    box = trimesh.creation.box((4.0, 3.0, 2.5))
    box.visual.vertex_colors = np.tile([*RED, 255], (8, 1))
    (tmp_path / "box.ply").write_bytes(box.export(file_type="ply", encoding=encoding))
    mesh = wr.Mesh.load(tmp_path / "box.ply")
    np.testing.assert_allclose(mesh.face_colours, [np.array(RED) / 255.0] * 12, atol=1e-5)


@pytest.mark.parametrize(
    "kind, half", [("uchar", 51), ("int", 51), ("short", 51), ("ushort", 13107), ("float", 0.2)]
)
def test_colours_of_ply_files_are_shares_of_white_whatever_their_type(kind, half, tmp_path):
    lines = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {x}" for x in "xyz")]
    lines += [f"property {kind} {name}" for name in ("red", "green", "blue")]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    lines += [f"{row} {half} 0 0" for row in ("0 0 0", "1 0 0", "0 1 0")]
    (tmp_path / "m.ply").write_text("\n".join([*lines, "3 0 1 2", ""]))
    np.testing.assert_allclose(wr.Mesh.load(tmp_path / "m.ply").face_colours, [[0.2, 0, 0]], atol=1e-6)


def test_obj_files_of_windows_are_read_whole(tmp_path):
    """With a byte order mark, and lines that go on behind a backslash."""
    text = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 \\\n3\n"
    for name, content in (("m.obj", text), ("m.mtl", "newmtl red\nKd 1 0 0\n")):
        (tmp_path / name).write_bytes(content.replace("\n", "\r\n").encode("utf-8-sig"))
    mesh = wr.Mesh.load(tmp_path / "m.obj")
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2]])
    np.testing.assert_array_equal(mesh.face_colours, [[1, 0, 0]])


def test_colours_of_an_obj_file_that_are_no_shares_of_white_are_refused(tmp_path):
    (tmp_path / "m.obj").write_text("v 0 0 0 255 0 9\nv 1 0 0 255 0 9\nv 0 1 0 255 0 9\nf 1 2 3\n")
    with pytest.raises(ValueError, match=r"m\.obj holds colours outside 0 to 1"):
        wr.Mesh.load(tmp_path / "m.obj")


def test_colours_and_names_travel_with_a_mesh(tmp_path):
    mesh = wr.Mesh.load(room_glb(tmp_path))
    wr.Reconstruction.from_files(mesh=mesh).save(tmp_path / "kept")
    for other in (pickle.loads(pickle.dumps(mesh)), wr.Reconstruction.load(tmp_path / "kept").mesh):
        np.testing.assert_array_equal(other.face_colours, mesh.face_colours)
        np.testing.assert_array_equal(other.face_label, mesh.face_label)
        assert other.labels == mesh.labels


def test_a_simplified_mesh_keeps_its_shape_colours_and_names(tmp_path):
    pytest.importorskip("open3d", reason="Open3D is an extra")
    ball = trimesh.creation.icosphere(subdivisions=4, radius=2.0)
    upper = ball.triangles_center[:, 2] > 0
    ball.visual.face_colors = np.where(upper[:, None], [*RED, 255], [*BLUE, 255])
    ball.export(tmp_path / "ball.ply")
    mesh = wr.Mesh.load(tmp_path / "ball.ply", simplify=500)
    assert 450 <= len(mesh.faces) <= 500
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 2.0, atol=0.03)
    height = mesh.triangles.mean(axis=1)[:, 2]
    expected = np.where(height[:, None] > 0, np.array(RED), np.array(BLUE)) / 255.0
    clear = np.abs(height) > 0.3
    np.testing.assert_allclose(mesh.face_colours[clear], expected[clear], atol=1e-5)


def test_numbered_pages_of_a_scan_are_no_materials(tmp_path):
    path = obj_with_materials(tmp_path)
    for name in ("square.obj", "square.mtl"):
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_text(text.replace("Wood_01", "material_0"))
    mesh = wr.Mesh.load(path)
    assert mesh.labels == ("Paint",)
    np.testing.assert_array_equal(mesh.face_label, [-1, -1, 0])


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_a_picture_that_materials_share_is_decoded_once(kind, tmp_path, monkeypatch):
    if kind == "glb":
        path = changed_glb(room_glb(tmp_path), lambda h: h.update(materials=h["materials"][1:] * 2))
    else:
        path, materials = obj_with_materials(tmp_path), tmp_path / "square.mtl"
        materials.write_text(materials.read_text().replace("Kd 0.9 0.1 0.2", "map_Kd pages/wood.png"))
    read, decoded = mesh_content.read_picture, []
    for module in gltf_files, obj_files:
        monkeypatch.setattr(module, "read_picture", lambda *a: decoded.append(a) or read(*a))
    assert wr.Mesh.load(path).face_colours is not None
    assert len(decoded) == 1


@pytest.mark.parametrize(
    ("make", "names", "name", "outside"),
    [
        (obj_with_materials, "square.obj", "square.mtl", "../square.mtl"),
        (obj_with_materials, "square.mtl", "pages/wood.png", "{}/wood.png"),
        (room_gltf, "model.gltf", "gltf_buffer_0.bin", "..%2Fgltf_buffer_0.bin"),
    ],
)
def test_files_outside_the_folder_are_read_only_if_that_is_asked_for(make, names, name, outside, tmp_path):
    folder = tmp_path / "model"
    folder.mkdir()
    path = make(folder)
    (folder / names).write_text((folder / names).read_text().replace(name, outside.format(tmp_path)))
    (folder / name).rename(tmp_path / Path(name).name)
    with pytest.raises(ValueError, match=rf"{path.name}.*outside its folder.*allow_outside=True"):
        wr.Mesh.load(path)
    assert wr.Mesh.load(path, allow_outside=True).face_colours is not None


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda h: h["accessors"][0].update(count=10**9), "accessor 0 states"),
        (lambda h: h["nodes"][0].update(children=[0]), "two parents"),
        (lambda h: h.update(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco.* without"),
        (
            lambda h: h.update(extensionsUsed=["EXT_mesh_gpu_instancing"]),
            "EXT_mesh_gpu_instancing; export it without",
        ),
        (lambda h: h["meshes"][0]["primitives"][0].update(mode=6), "fans"),
        (lambda h: h.pop("scenes"), "without a scene.*export it with one"),
        (lambda h: [n.update(skin=0) for n in h["nodes"]], "skin or morph weights; export"),
        (lambda h: h["meshes"][1].update(weights=[0.0, 0.5]), "skin or morph weights; export"),
    ],
)
def test_a_gltf_header_that_does_not_fit_its_data_is_refused(change, told, tmp_path):
    path = changed_glb(room_glb(tmp_path), change)
    with pytest.raises(ValueError, match=rf"room\.glb.*({told})"):
        wr.Mesh.load(path)


@pytest.mark.parametrize(("kind", "code"), [("u1", 5121), ("<u2", 5123)])
def test_texture_coordinates_of_gltf_bytes_and_shorts_are_shares(kind, code, tmp_path):
    """As the core of the format has them: the upper half of the picture, which is red."""
    most = np.iinfo(kind).max
    data = (np.array([[0.0, 0.05], [1.0, 0.05], [1.0, 0.45], [0.0, 0.45]]) * most).astype(kind).tobytes()

    def change(h):
        uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
        h["buffers"].append({"uri": uri, "byteLength": len(data)})
        h["bufferViews"].append({"buffer": len(h["buffers"]) - 1, "byteLength": len(data)})
        view = {"bufferView": len(h["bufferViews"]) - 1, "componentType": code, "type": "VEC2", "count": 4}
        h["accessors"].append(view | {"normalized": True})
        table = next(m for m in h["meshes"] if m["name"] == "table")
        table["primitives"][0]["attributes"]["TEXCOORD_0"] = len(h["accessors"]) - 1

    mesh = wr.Mesh.load(changed_glb(room_glb(tmp_path), change))
    wood = mesh.face_label == mesh.labels.index("Wood_01")
    np.testing.assert_allclose(mesh.face_colours[wood], [np.array(RED) / 255.0] * 4, atol=1e-3)


def test_colours_of_glossy_gltf_materials_are_those_of_usual_ones(tmp_path):
    def change(h):
        for material in h["materials"]:
            usual = material.pop("pbrMetallicRoughness")
            names = {"baseColorFactor": "diffuseFactor", "baseColorTexture": "diffuseTexture"}
            glossy = {names[k]: value for k, value in usual.items() if k in names}
            material["extensions"] = {"KHR_materials_pbrSpecularGlossiness": glossy}

    wanted = read_mesh(room_glb(tmp_path))
    found = read_mesh(changed_glb(room_glb(tmp_path), change))
    np.testing.assert_array_equal(found.face_colours, wanted.face_colours)
    assert found.material_names == wanted.material_names


def test_a_gltf_node_without_a_name_is_called_as_its_mesh(tmp_path):
    path = changed_glb(room_glb(tmp_path), lambda h: [n.pop("name") for n in h["nodes"]])
    assert set(read_mesh(path).object_names) == {"room", "table"}


def test_lines_of_a_gltf_file_are_no_triangles(tmp_path):
    path = changed_glb(room_glb(tmp_path), lambda h: h["meshes"][0]["primitives"][0].update(mode=1))
    assert len(wr.Mesh.load(path).faces) == 4


@pytest.mark.parametrize("most", [10, 15])
def test_a_small_file_that_makes_many_triangles_is_refused(most, tmp_path, monkeypatch):
    monkeypatch.setattr(gltf_files, "LARGEST_FACES", most)  # 12 and 2 are made, 2 of them stand there twice
    with pytest.raises(ValueError, match=rf"room\.glb.*more than {most} triangles"):
        wr.Mesh.load(room_glb(tmp_path))


def test_vertices_at_one_place_become_one_in_the_file_s_order(tmp_path):
    text = "v 1 0 0\nv -0 0 0\nv 0 1 0\nv 0 -0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\nf 4 5 6\n"
    (tmp_path / "two.obj").write_text(text)
    content = load_mesh(tmp_path / "two.obj")
    np.testing.assert_array_equal(content.vertices, [[1, 0, 0], [0, 0, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(content.faces, [[0, 1, 2], [1, 0, 3]])


def test_a_ply_of_triangles_and_few_other_polygons_is_read(tmp_path):
    """Its rows differ in length, so that they are walked one by one, far beyond what a byte counts."""
    x, y = np.divmod(np.arange(144.0), 12)
    grid = np.column_stack([x, y, 0 * x])
    corner = np.array([12 * i + j for i in range(11) for j in range(11)])
    faces = [list(f) for k in corner for f in ((k, k + 12, k + 13), (k, k + 13, k + 1))]
    faces[-2:] = [[corner[-1], corner[-1] + 12, corner[-1] + 13, corner[-1] + 1]]
    path = tmp_path / "mixed.ply"
    path.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 144\nproperty float x\nproperty float y\nproperty float z\n"
        + f"element face {len(faces)}\nproperty list uchar uint vertex_indices\nend_header\n".encode()
        + grid.astype("<f4").tobytes()
        + b"".join(bytes([len(f)]) + np.array(f, "<u4").tobytes() for f in faces)
    )
    assert wr.Mesh.load(path).areas.sum() == pytest.approx(121.0)


@pytest.mark.parametrize("origin", [(0, 0, 0), (500_000, 4_000_000, 300)])
def test_a_written_mesh_stays_where_it_is_in_coordinates_of_maps_too(origin, tmp_path):
    corners = np.random.default_rng(0).uniform(-20, 20, (30, 3)) + origin
    write_mesh(tmp_path / "mesh.ply", corners, np.arange(30).reshape(-1, 3))
    np.testing.assert_allclose(wr.Mesh.load(tmp_path / "mesh.ply").vertices, corners, rtol=0, atol=1e-5)


def test_texture_coordinates_that_are_nan_are_left_out(tmp_path):
    corners, faces = np.eye(3), [[0, 1, 2]]
    write_mesh(tmp_path / "mesh.ply", corners, faces, uv=np.full((3, 2), 0.625))
    data, known = (tmp_path / "mesh.ply").read_bytes(), np.float32(0.625).tobytes()
    assert data.count(known) == 6
    (tmp_path / "nan.ply").write_bytes(data.replace(known, np.float32(np.nan).tobytes()))
    whole = read_mesh(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(whole.uv, np.full((3, 2), 0.625))
    np.testing.assert_array_equal(whole.faces, faces)
    found = read_mesh(tmp_path / "nan.ply")
    assert found.uv is None
    np.testing.assert_array_equal(found.vertices, corners)


@pytest.mark.parametrize("first", range(8))
def test_a_wall_drawn_as_one_polygon_keeps_its_doorway(first, tmp_path):
    outline = np.array([[0, 0], [1, 0], [1, 2], [2, 2], [2, 0], [5, 0], [5, 3], [0, 3]])
    rows = [f"{x} 7 {z}" for x, z in np.roll(outline, first, axis=0)]
    vertices, corners = "\n".join(f"v {row}" for row in rows), " ".join(map(str, range(1, 9)))
    (tmp_path / "wall.obj").write_text(f"{vertices}\nusemtl wood\nf {corners}\nusemtl glass\nf 1 2 3\n")
    header = (
        "ply\nformat ascii 1.0\nelement vertex 8\nproperty double x\nproperty double y\nproperty double z\n"
    )
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "wall.ply").write_text(header + "\n".join(rows) + "\n8 0 1 2 3 4 5 6 7\n")
    for name in ("wall.obj", "wall.ply"):
        mesh = wr.Mesh.load(tmp_path / name, unit="m")
        # 5 m by 3 m without a door of 1 m by 2 m, wound in one way
        assert mesh.areas[:6].sum() == pytest.approx(5 * 3 - 1 * 2)
        np.testing.assert_allclose(mesh.face_normals[:6], np.tile([0.0, -1.0, 0.0], (6, 1)), atol=1e-12)
    assert wr.Mesh.load(tmp_path / "wall.obj", unit="m").face_label.tolist() == [0] * 6 + [1]


def test_a_polygon_that_crosses_itself_is_cut_as_far_as_it_goes():
    points = np.column_stack([np.random.default_rng(0).random((300, 2)), np.zeros(300)])
    index, polygon = mesh_content.triangulated(np.array([300, 3]), np.r_[:300, :3], points)
    assert index.shape == (299, 3) and polygon.tolist() == [0] * 298 + [1]
    assert index[:298].min() == 0 and index[:298].max() == 299 and index[298].tolist() == [300, 301, 302]
