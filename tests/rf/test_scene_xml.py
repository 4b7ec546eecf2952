"""Scenes in XML: materials by name, type and reference, transforms and primitives, hostile files; beside Mitsuba."""

import numpy as np
import pytest
import trimesh
from radio_scenes import box_mesh, enclosed_volume, is_wound_alike, object_faces
from sionna_room import sionna_or_skip

import warprrf as wr
from warprrf.geometry.mesh_files import write_mesh
from warprrf.rf.scene import Scene

F = 3.5e9
RECTANGLE = '<shape type="rectangle" id="{name}">{inside}</shape>'


def written(folder, body):
    """The file of a scene's inside, or of a text that begins as files do."""
    path = folder / "scene.xml"
    path.write_text(body if body.startswith(("<?", "<!")) else f'<scene version="3.0.0">{body}</scene>')
    return path


def loaded(folder, body, **options):
    return Scene.load(written(folder, body), **options)  # type: ignore[arg-type]


def one(folder, bsdf, **options):
    """The material of a scene of one rectangle, whose bsdf is the first of ``bsdf``."""
    return loaded(folder, bsdf + '<shape type="rectangle"><ref id="it"/></shape>', **options).materials[0]


def test_materials_have_the_values_that_the_file_gives(tmp_path):
    itu = one(
        tmp_path,
        '<bsdf type="itu-radio-material" id="it"><string name="type" value="brick"/>'
        '<float name="thickness" value="0.3"/><float name="scattering_coefficient" value="0.4"/>'
        '<float name="xpd_coefficient" value="0.2"/></bsdf>',
    )
    assert (itu.name, itu.itu, itu.thickness_m, itu.scattering, itu.xpd) == ("it", "brick", 0.3, 0.4, 0.2)
    assert itu.relative_permittivity(F) == 3.91
    own = one(
        tmp_path,
        '<bsdf type="radio-material" id="it"><float name="relative_permittivity" value="4"/>'
        '<float name="conductivity" value="0.5"/><string name="scattering_pattern" value="directive"/>'
        '<integer name="alpha_r" value="7"/></bsdf>',
    )
    assert (own.relative_permittivity(1e12), own.conductivity(1e7)) == (4.0, 0.5)
    assert (own.thickness_m, own.scattering, own.pattern, own.alpha_r) == (0.1, 0.0, "directive", 7)


@pytest.mark.parametrize(
    "bsdf",
    [
        '<bsdf type="diffuse" id="{}"/>',
        '<bsdf type="twosided" id="{}"><bsdf type="diffuse"/></bsdf>',
        '<bsdf type="twosided" id="x"><bsdf type="diffuse" id="{}"/></bsdf><alias id="x" as="{}"/>',
        '<bsdf type="twosided" id="y"><ref id="z"/></bsdf><bsdf type="diffuse" id="z"><bsdf id="{}"/></bsdf>'
        '<alias id="y" as="{}"/>',
    ],
)
@pytest.mark.parametrize("name", ["mat-itu_glass", "itu_glass", "itu-glass", "glass", "mat-itu_glass.001"])
def test_plain_and_nested_bsdfs_are_taken_by_their_name(tmp_path, bsdf, name):
    body = bsdf.replace("{}", name) + RECTANGLE.format(name="a", inside=f'<ref id="{name}"/>')
    assert loaded(tmp_path, body).materials[0].itu == "glass"


def test_what_nobody_knows_is_named_and_can_be_given(tmp_path):
    with pytest.raises(ValueError, match=r"'shape_0'.*'it'.*concrete.*materials="):
        one(tmp_path, '<bsdf type="diffuse" id="it"/>')
    cork = wr.Material.custom("cork", relative_permittivity=1.7)
    assert one(tmp_path, '<bsdf type="diffuse" id="it"/>', materials={"it": cork}) == cork
    with pytest.raises(ValueError, match="^materials: got 'that'.*it has it"):
        one(tmp_path, '<bsdf type="diffuse" id="it"/>', materials={"it": cork, "that": cork})
    with pytest.raises(ValueError, match="circle"):
        one(tmp_path, '<bsdf type="twosided" id="it"><ref id="it"/></bsdf>')
    with pytest.raises(ValueError, match=r"'it'.*'thickness'.*'thick'"):
        one(tmp_path, '<bsdf type="radio-material" id="it"><float name="thickness" value="thick"/></bsdf>')


def test_what_is_declared_otherwise_under_one_name_is_another_material(tmp_path):
    wall = '<bsdf type="itu-radio-material"><string name="type" value="brick"/><float name="thickness" value="{}"/></bsdf>'
    body = "".join(
        RECTANGLE.format(name=f"{k}", inside=wall.format(thickness))
        for k, thickness in enumerate((0.1, 0.3, 0.1))
    )
    body += '<bsdf type="radio-material" id="brick"><float name="relative_permittivity" value="9"/></bsdf>'
    body += RECTANGLE.format(name="3", inside='<ref id="brick"/>')
    scene = loaded(tmp_path, body)
    own = [scene.materials[m] for m in scene.face_material[::2]]
    assert [m.thickness_m for m in own] == [0.1, 0.3, 0.1, 0.1]
    assert [m.relative_permittivity(F) for m in own] == [3.91, 3.91, 3.91, 9.0]
    assert [m.name for m in scene.materials] == ["brick", "brick_2", "brick_3"]
    given = {"brick": wr.em.itu_material("wood")}
    assert loaded(tmp_path, body, materials=given).materials == [given["brick"]]


def test_callers_go_before_tables_and_tables_before_files(tmp_path):
    from warprrf.files import write_json
    from warprrf.rf.em.materials import table_entry

    thick = wr.em.itu_material("wood", thickness_m=0.5)
    write_json(tmp_path / "materials.json", {"materials": [table_entry(thick)]})
    body = "".join(
        RECTANGLE.format(name=name, inside=f'<bsdf type="diffuse" id="itu_{name}"/>')
        for name in ("wood", "brick")
    )
    scene = loaded(tmp_path, body)
    assert [m.thickness_m for m in scene.materials] == [0.5, 0.1]
    other = wr.em.itu_material("brick", thickness_m=0.2)
    assert [m.thickness_m for m in loaded(tmp_path, body, materials={"brick": other}).materials] == [0.5, 0.2]


def test_outside_their_bands_materials_hold_on_request_alone(tmp_path):
    body = '<bsdf type="diffuse" id="it"/>'.replace('"it"', '"itu_metal"')
    body += RECTANGLE.format(name="a", inside='<ref id="itu_metal"/>')
    with pytest.raises(ValueError, match=r"metal.*1 to 100 GHz.*extrapolate=True"):
        loaded(tmp_path, body).materials[0].permittivity(300e9)
    held = loaded(tmp_path, body, extrapolate=True).materials[0]
    assert held.conductivity(300e9) == 1e7
    assert held.band(300e9).source.startswith("extrapolated from 1 to 100 GHz: ITU-R P.2040")
    assert held.band(10e9).source == "ITU-R P.2040-3, table 3"


TRANSFORMS = [
    '<translate x="1" y="-2" z="0.5"/>',
    '<translate value="1, 2, 3"/><rotate z="1" angle="30"/>',
    '<rotate x="0.36" y="0.48" z="-0.8" angle="115"/><scale value="2"/><translate x="4"/>',
    '<scale x="1" y="-2" z="3"/><rotate value="0 1 0" angle="-40"/>',
    '<lookat origin="1, 2, 3" target="-2, 0.5, 1" up="0, 0, 1"/>',
    '<matrix value="0 -1 0 4 1 0 0 5 0 0 2 6 0 0 0 1"/><translate z="1"/>',
    '<matrix value="0 -1 0 1 0 0 0 0 3"/>',
]


def test_surfaces_stand_where_mitsuba_puts_them(tmp_path):
    sionna_or_skip()
    from warprrf.rf.scene_sionna import select_variant

    mitsuba = select_variant()
    write_mesh(tmp_path / "box.ply", *box_mesh([0, 0, 0], [1, 2, 3]))
    trimesh.Trimesh(*box_mesh([0, 0, 0], [1, 2, 3]), process=False).export(tmp_path / "box.obj")
    shapes = [
        f'<shape type="{kind}" id="{kind}{k}">{file}<transform name="to_world">{transform}</transform>'
        '<bsdf type="diffuse" id="itu_wood"/></shape>'
        for k, transform in enumerate(TRANSFORMS)
        for kind, file in (
            ("ply", '<string name="filename" value="box.ply"/>'),
            ("obj", '<string name="filename" value="box.obj"/>'),
            ("cube", ""),
        )
    ]
    body = "".join(shapes)
    ours = loaded(tmp_path, body)
    plain = body.replace('id="itu_wood"', "").replace('value="box', f'value="{tmp_path}/box')
    theirs = mitsuba.load_string(f'<scene version="3.0.0">{plain}</scene>', optimize=False)
    for shape in theirs.shapes():
        corners = np.array(shape.vertex_positions_buffer()).reshape(-1, 3)
        mine = ours.mesh.triangles[object_faces(ours, shape.id())].reshape(-1, 3)
        gap = np.linalg.norm(mine[:, None] - corners, axis=2)
        assert gap.min(axis=1).max() < 1e-5 and gap.min(axis=0).max() < 1e-5, shape.id()


def test_solids_keep_their_outer_side_and_primitives_their_size(tmp_path):
    def solid(inside, kind="cube"):
        return loaded(tmp_path, f'<shape type="{kind}"><bsdf id="itu_wood"/>{inside}</shape>').mesh

    for place, volume in (("", 8.0), ('<scale x="-1"/>', 8.0), ('<scale value="0.5"/>', 1.0)):
        mesh = solid(f'<transform name="to_world">{place}</transform>')
        assert is_wound_alike(mesh.vertices, mesh.faces)
        assert enclosed_volume(mesh.vertices, mesh.faces) == pytest.approx(volume)
    flipped = solid('<boolean name="flip_normals" value="true"/>')
    assert enclosed_volume(flipped.vertices, flipped.faces) == pytest.approx(-8.0)
    ball = solid('<float name="radius" value="2"/><point name="center" x="5" y="0" z="1"/>', "sphere")
    assert ball.is_closed and (ball.areas > 0).all()
    assert enclosed_volume(ball.vertices - [5, 0, 1], ball.faces) == pytest.approx(
        4 / 3 * np.pi * 8, rel=0.01
    )
    np.testing.assert_allclose(np.linalg.norm(ball.vertices - [5, 0, 1], axis=1), 2.0)
    tube = solid('<point name="p0" value="1,1,1"/><point name="p1" value="1,1,4"/>', "cylinder")
    assert tube.areas.sum() == pytest.approx(2 * np.pi * 3, rel=0.01)
    assert np.einsum("ij,ij->i", tube.face_normals, tube.triangles.mean(axis=1) - [1, 1, 2.5]).min() > 0
    for kind, area in (("disk", np.pi), ("rectangle", 4.0)):
        flat = solid("", kind)
        assert flat.areas.sum() == pytest.approx(area, rel=0.01)
        np.testing.assert_allclose(flat.face_normals, np.tile([0, 0, 1], (len(flat.faces), 1)), atol=1e-12)


def test_properties_have_the_names_of_older_files_too(tmp_path):
    """Mitsuba, and so Sionna RT, takes ``toWorld`` for ``to_world`` in files of a version below 2."""
    inside = (
        '<boolean name="flipNormals" value="true"/><transform name="toWorld"><translate z="5"/></transform>'
    )
    mesh = loaded(tmp_path, RECTANGLE.format(name="a", inside=f'{inside}<bsdf id="itu_wood"/>')).mesh
    np.testing.assert_array_equal(mesh.vertices[:, 2], 5.0)
    np.testing.assert_array_equal(mesh.face_normals, [[0, 0, -1]] * 2)


def test_defaults_includes_and_merged_shapes_are_read(tmp_path):
    (tmp_path / "more.xml").write_text(
        '<scene version="3.0.0"><shape type="$kind" id="mesh-far"><bsdf id="itu_wood"/></shape></scene>'
    )
    scene = loaded(
        tmp_path,
        '<default name="kind" value="cube"/><include filename="more.xml"/><shape type="merge">'
        + RECTANGLE.format(name="mesh-near", inside='<bsdf id="itu_brick"/>')
        + "</shape>",
    )
    assert scene.object_names == ["far", "near"]
    assert [m.name for m in scene.materials] == ["wood", "brick"]


CUBE = '<shape type="cube"><bsdf id="itu_wood"/>{}</shape>'
HOSTILE = {
    "encoding": ('<?xml version="1.0" encoding="no-such"?>', "unknown encoding"),
    "external entity": (
        '<!DOCTYPE s [<!ENTITY x SYSTEM "file:///etc/passwd">]>\n<x>&x;</x>',
        "document type",
    ),
    "entities that multiply": (
        "<!DOCTYPE s [<!ENTITY a '"
        + "ha" * 50
        + "'>"
        + "".join(f"<!ENTITY {b} '{f'&{a};' * 40}'>" for a, b in zip("abcdef", "bcdefg", strict=True))
        + "]>\n<x>&g;</x>",
        "document type",
    ),
    "depth": ("<a>" * 100_000 + "</a>" * 100_000, "nested more than"),
    "a name that grows": (
        '<default name="a" value="0000000000"/>'
        + "".join(
            f'<default name="{b}" value="{f"${a}" * 10}"/>' for a, b in zip("abcde", "bcdef", strict=True)
        )
        + CUBE.format(""),
        "more than 10000 characters",
    ),
    "itself": ('<include filename="scene.xml"/>', "deep"),
    "a file above": ('<include filename="../scene.xml"/>', "outside"),
    "a name twice": (2 * CUBE.replace("cube", 'cube" id="a').format(""), "alike"),
    "a material twice": ('<bsdf id="itu_wood"/><bsdf id="itu_wood"/>' + CUBE.format(""), "two bsdfs alike"),
    "half an exponent": (
        CUBE.replace("/>", '><float name="alpha_r" value="7.5"/></bsdf>', 1).format(""),
        "alpha_r.*7.5.*whole number",
    ),
    "a perspective": (
        CUBE.format(
            '<transform name="to_world"><matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0"/></transform>'
        ),
        "last row",
    ),
}


@pytest.mark.parametrize("case", sorted(HOSTILE))
def test_hostile_and_wrong_files_are_value_errors_that_name_them(tmp_path, case):
    body, words = HOSTILE[case]
    with pytest.raises(ValueError, match=rf"(?s)^path: .*scene\.xml.*{words}|^path: .*{words}"):
        loaded(tmp_path, body)
