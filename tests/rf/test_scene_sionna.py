"""Scenes from and to Sionna RT in memory: what goes over comes back."""

import numpy as np
import pytest
from radio_scenes import object_faces
from sionna_room import write_scene

import warprrf as wr
from warprrf.rf.scene import Scene


def test_a_scene_of_sionna_is_the_scene_of_its_file(rt):
    live = rt.load_scene(rt.scene.simple_street_canyon_with_cars, merge_shapes=False)
    live.add(rt.Transmitter("mast", position=[1.1, 2.0, 30.0]))
    live.add(rt.Receiver("phone", position=[-4.0, 0.3, 1.5]))
    ours, file = Scene.from_sionna(live), Scene.load(rt.scene.simple_street_canyon_with_cars)
    assert ours.object_names == file.object_names
    for name in file.object_names:
        np.testing.assert_allclose(
            ours.mesh.triangles[object_faces(ours, name)], file.mesh.triangles[object_faces(file, name)]
        )
        mine, theirs = (s.materials[s.face_material[object_faces(s, name)[0]]] for s in (ours, file))
        assert mine == theirs
    assert ours.transmitters.keys() == {"mast"} and ours.receivers.keys() == {"phone"}
    np.testing.assert_array_equal(ours.transmitters["mast"], [1.1, 2.0, 30.0])


def test_a_scene_goes_to_sionna_and_back(rt, tmp_path):
    first = write_scene(tmp_path)  # its material of 5 S/m scatters in a lobe
    own = wr.em.itu_material("wood", name="board", scattering=0.3, xpd=0.4)
    scene = Scene(
        first.mesh,
        [first.materials[0], own],
        first.face_material,
        face_object=first.face_object,
        object_names=["walls of.001", "board"],  # as one of the materials: Sionna has one set of names
        transmitters={"tx": [1, 2, 3]},
        receivers={"a": [0, 0, 1], "b": [0.5, 0, 1.25]},
    )
    live = scene.to_sionna(frequency_hz=10e9)
    back = Scene.from_sionna(live)
    np.testing.assert_allclose(back.mesh.triangles, scene.mesh.triangles, atol=1e-6)
    np.testing.assert_array_equal(back.face_material, scene.face_material)
    assert back.object_names == ["walls of_001", "board"]  # Mitsuba has no dots in names
    for mine, theirs in zip(scene.materials, back.materials, strict=True):
        assert (theirs.thickness_m, theirs.scattering, theirs.pattern, theirs.alpha_r, theirs.xpd) == (
            mine.thickness_m, mine.scattering, mine.pattern, mine.alpha_r, mine.xpd,
        )  # fmt: skip
        assert theirs.permittivity(10e9) == pytest.approx(mine.permittivity(10e9), rel=1e-6)
    assert {name: list(point) for name, point in back.receivers.items()} == {
        "a": [0, 0, 1],
        "b": [0.5, 0, 1.25],
    }
    live.frequency = 60e9  # materials follow it
    wood = live.objects["board"].radio_material
    assert float(wood.conductivity.numpy()[0]) == pytest.approx(own.conductivity(60e9), rel=1e-6)
    with pytest.raises(ValueError, match="0.0001 GHz"):
        scene.to_sionna(frequency_hz=1e5)


def test_an_object_of_two_materials_becomes_two_objects(rt, tmp_path):
    first = write_scene(tmp_path)
    live = Scene(first.mesh, first.materials, first.face_material, object_names=["all"]).to_sionna()
    assert set(live.objects) == {"all-stone", "all-board"}


def test_what_cannot_be_taken_over_is_named(rt):
    with pytest.raises(TypeError, match="^rt_scene: got str"):
        Scene.from_sionna("scene.xml")
    with pytest.raises(ValueError, match="^rt_scene: got a scene without objects"):
        Scene.from_sionna(rt.Scene())
    live = rt.load_scene(rt.scene.simple_wedge)
    radio = live.radio_materials["concrete"]
    radio.scattering_pattern = rt.BackscatteringPattern(alpha_r=3, alpha_i=2, lambda_=0.5)
    # Nothing scatters: its pattern does not count.
    assert Scene.from_sionna(live).materials[0].scattering == 0.0
    radio.scattering_coefficient = 0.5
    with pytest.raises(ValueError, match="'concrete'.*BackscatteringPattern.*materials="):
        Scene.from_sionna(live)
    wood = wr.em.itu_material("wood")
    assert Scene.from_sionna(live, materials={"concrete": wood}).materials == [wood]


def test_a_law_in_python_holds_at_its_frequency_alone(rt):
    live = rt.load_scene(rt.scene.simple_wedge)
    own = rt.RadioMaterial("own", frequency_update_callback=lambda f: (2.5, 0.125))
    live.add(own)
    next(iter(live.objects.values())).radio_material = own
    material = Scene.from_sionna(live).materials[0]
    assert material.permittivity(3.5e9).real == 2.5
    with pytest.raises(ValueError, match="3.5 to 3.5 GHz|3.5 GHz"):
        material.permittivity(4e9)
