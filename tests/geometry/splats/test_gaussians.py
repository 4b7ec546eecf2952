"""Gaussians: what they refuse, and the INRIA PLY layout there and back."""

import numpy as np
import pytest

from warprrf.geometry.splats.gaussians import Gaussians


def some(n=5, coefficients=16, seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.normal(size=(n, 3)), rng.normal(size=(n, 4)), rng.uniform(0.01, 1, (n, 3)), rng.uniform(0.01, 0.99, n),
        rng.normal(size=(n, coefficients, 3)),
    )  # fmt: skip


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_ply_holds_every_attribute(tmp_path, coefficients):
    g = some(coefficients=coefficients)
    g.save_ply(tmp_path / "g.ply")
    back = Gaussians.load_ply(tmp_path / "g.ply")
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        assert np.allclose(getattr(back, name), getattr(g, name), rtol=1e-5, atol=1e-6), name


def test_gaussians_stay_as_they_are_where_their_caller_goes_on_with_the_arrays():
    arrays = {name: getattr(some(), name) for name in ("means", "quaternions", "scales", "opacities", "sh")}
    g = Gaussians(**arrays)
    for array in arrays.values():
        array[:] = 7.0
    assert g.opacities.max() <= 1
    for name in arrays:
        assert np.array_equal(getattr(g, name), getattr(some(), name))


def test_no_gaussians_are_kept_too(tmp_path):
    some(coefficients=4)[:0].save_ply(tmp_path / "g.ply")
    assert Gaussians.load_ply(tmp_path / "g.ply").sh.shape == (0, 4, 3)


def test_ply_layout_is_the_one_that_other_viewers_read(tmp_path):
    g = some(n=2, coefficients=4)
    g.save_ply(tmp_path / "g.ply")
    header, body = (tmp_path / "g.ply").read_bytes().split(b"end_header\n")
    names = [line.split()[-1] for line in header.decode().split("\n") if line.startswith("property")]
    rest = [f"f_rest_{k}" for k in range(9)]
    last = "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    assert names == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, *last]
    row = dict(zip(names, np.frombuffer(body, "<f4").reshape(2, -1)[1], strict=True))
    assert row["f_rest_1"] == g.sh[1, 2, 0]  # channel-major: second harmonic of red
    assert row["f_rest_3"] == g.sh[1, 1, 1]  # first harmonic of green
    assert row["opacity"] == pytest.approx(np.log(g.opacities[1] / (1 - g.opacities[1])), rel=1e-4)
    assert row["scale_2"] == pytest.approx(np.log(g.scales[1, 2]), rel=1e-5)
    assert row["rot_0"] == g.quaternions[1, 0]


def test_ascii_and_shuffled_properties_are_read(tmp_path):
    lines = ["ply", "format ascii 1.0", "comment hand-written", "element vertex 1"]
    values = {"opacity": 0, "x": 1, "y": 2, "z": 3, "f_dc_0": 0.1, "f_dc_1": 0.2, "f_dc_2": 0.3}
    values |= {f"scale_{k}": np.log(0.5) for k in range(3)} | {"rot_0": 2, "rot_1": 0, "rot_2": 0, "rot_3": 0}
    lines += [f"property float {name}" for name in values]
    lines += ["end_header", " ".join(str(v) for v in values.values()), ""]
    (tmp_path / "a.ply").write_text("\n".join(lines))
    g = Gaussians.load_ply(tmp_path / "a.ply")
    assert g.means.tolist() == [[1, 2, 3]] and g.opacities[0] == 0.5
    assert np.allclose(g.scales, 0.5) and np.allclose(g.quaternions, [[1, 0, 0, 0]])
