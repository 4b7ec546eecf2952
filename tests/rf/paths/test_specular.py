"""Paths as a function of ends, orientations and materials: the values of `trace_paths`, in NumPy, on Warp's tape and in torch;
slopes of what is traced anew."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from radio_scenes import box_mesh, joined

import warprrf as wr
from warprrf.rf.paths.specular import MATERIALS, OUTPUTS, POSITIONS
from warprrf.rf.positions import retraced_slope

F, TX = 60e9, np.array([-2.1, 0.3, 1.7])
RX = np.array([[2.2, -0.7, 1.2], [1.9, 1.1, 0.8], [-1.0, -1.5, 2.0]])
ROUGH = replace(wr.em.itu_material("plasterboard", thickness_m=0.02).extrapolated(), roughness_m=2e-4)
GLASS = wr.em.itu_material("glass", thickness_m=0.012, scattering=0.3).extrapolated()
PANE = (
    np.array([[1.0, y, z] for y, z in ((-3, 0.0), (3, 0.0), (3, 3), (-3, 3))]),
    np.array([[0, 1, 2], [0, 2, 3]]),
)


@pytest.fixture(autouse=True)
def _on_the_cpu():
    """Where torch's tensors lie; tests/gradients run on GPUs too."""
    with wp.ScopedDevice("cpu"):
        yield


def room(*materials):
    mesh, part = joined(box_mesh([-4, -3, 0], [4, 3, 3], inward=True), PANE)
    return wr.Scene(mesh, materials or (ROUGH, GLASS), part)


ASKED = {"transmitter": TX, "frequency_hz": F, "mirror_order": 2, "transmissions": 1}
pytestmark = pytest.mark.filterwarnings("ignore:60 GHz")  # that diffraction is not asked for


def same(values, paths):
    for name in OUTPUTS:
        np.testing.assert_array_equal(getattr(values, name), getattr(paths, name)[paths.valid], err_msg=name)


def near(values, paths):
    for name in OUTPUTS:
        found, known = getattr(values, name), getattr(paths, name)[paths.valid]
        np.testing.assert_allclose(
            found, known, rtol=1e-9, atol=1e-11 * np.nanmax(np.abs(known)), err_msg=name
        )


def test_values_are_those_of_traced_paths_in_their_order():
    held, paths = (
        wr.paths.trace_specular(room(), receivers=RX, **ASKED),
        wr.trace_paths(room(), receivers=RX, **ASKED),
    )
    assert len(held) == paths.valid.sum() > 50
    same(held.evaluate(), paths)
    np.testing.assert_array_equal(held.receiver, np.nonzero(paths.valid)[0])
    alone = wr.paths.trace_specular(room(), receivers=RX[0], **ASKED).evaluate()
    np.testing.assert_array_equal(alone.gain, wr.trace_paths(room(), receivers=RX[0], **ASKED).gain)
    with wp.Tape():
        taped = held.evaluate(receivers=wp.array(RX, dtype=wp.vec3d, requires_grad=True))
    np.testing.assert_array_equal(taped.gain.numpy() @ [1, 1j], held.evaluate().gain)


def test_ends_may_move_as_far_as_paths_stay_the_same():
    held = wr.paths.trace_specular(room(), receivers=RX, **ASKED)
    near(held.evaluate(receivers=RX + 0.004), wr.trace_paths(room(), receivers=RX + 0.004, **ASKED))
    moved = wr.trace_paths(room(), receivers=RX, **(ASKED | {"transmitter": TX - 0.004}))
    near(held.evaluate(transmitter=TX - 0.004), moved)


@pytest.mark.parametrize("name", MATERIALS)
def test_materials_may_change(name):
    """A scene of the other material is traced to the same."""
    held = wr.paths.trace_specular(room(), receivers=RX, **ASKED)
    other = held.parameters[name] * 1.1
    known = {n: (other if n == name else v) for n, v in held.parameters.items() if n in MATERIALS}
    wall, glass = (
        wr.Material.custom(
            "m", relative_permittivity=known["relative_permittivity"][k], conductivity=known["conductivity"][k],
            thickness_m=known["thickness_m"][k], scattering=known["scattering"][k],
        )
        for k in range(2)
    )  # fmt: skip
    wall = replace(wall, scattering=None, roughness_m=known["roughness_m"][0])
    near(held.evaluate(**{name: other}), wr.trace_paths(room(wall, glass), receivers=RX, **ASKED))


def test_jones_matrices_of_turned_antennas_give_the_channel_between_them():
    """F_r^T J F_t in the antennas' own axes is the response of `Paths.cfr` to the same antennas turned."""
    turns = np.array([0.4, -0.7, 1.1]), np.array([-2.0, 0.5, 0.3])
    held = wr.paths.trace_specular(room(), receivers=RX[0], **ASKED)
    v = held.evaluate(transmitter_orientation=turns[0], receiver_orientation=turns[1])
    sent, heard = (
        np.sqrt(1.5) * np.sin(zenith) for zenith in (v.theta_t, v.theta_r)
    )  # short dipoles along z
    paths = wr.trace_paths(room(), receivers=RX[0], **ASKED)
    tx, rx = (wr.Antenna("dipole", "V").turned(turn) for turn in turns)
    h = paths.cfr([F], tx_array=tx, rx_array=rx, diffuse="power")[0, 0, 0]
    assert abs((heard * v.jones[:, 0, 0] * sent).sum() - h) < 1e-9 * abs(h)
    local = rx.rotation.T @ paths.arrival[0]
    np.testing.assert_allclose([np.cos(v.theta_r[0]), np.tan(v.phi_r[0])], [local[2], local[1] / local[0]])


def test_each_receiver_may_be_turned_by_itself():
    held, turns = (
        wr.paths.trace_specular(room(), receivers=RX, **ASKED),
        np.array([[0.1, 0.2, 0.3], [1, 2, 3], [0, 0, 0]]),
    )
    both = held.evaluate(receiver_orientation=turns)
    for k, turn in enumerate(turns):
        own = held.receiver == k
        np.testing.assert_array_equal(both.jones[own], held.evaluate(receiver_orientation=turn).jones[own])


def test_torch_differentiates_as_the_tape_does():
    held, rng = wr.paths.trace_specular(room(), receivers=RX, **ASKED), np.random.default_rng(0)
    weight = rng.normal(size=len(held))
    given = {name: held.parameters[name] for name in held.parameters}
    arrays = {
        k: wp.array(v, dtype=wp.vec3d if k in POSITIONS else wp.float64, requires_grad=True)
        for k, v in given.items()
    }
    with wp.Tape() as tape:
        values = held.evaluate(**arrays)
    gain = values.gain.numpy()
    tape.backward(
        grads={
            values.gain: wp.array(2.0 * weight[:, None] * gain, dtype=wp.vec2d),
            values.tau: wp.array(weight, dtype=wp.float64),
        }
    )
    tensors = {k: torch.tensor(v, requires_grad=True) for k, v in given.items()}
    found = held.evaluate(**tensors)
    np.testing.assert_array_equal(found.gain.detach(), held.evaluate().gain)
    of = torch.tensor(weight)
    loss = (of * found.gain.abs().square()).sum() + (of * found.tau).sum()
    loss.backward(retain_graph=True)
    for name, tensor in tensors.items():
        scale = np.abs(arrays[name].grad.numpy()).max()
        np.testing.assert_allclose(
            tensor.grad, arrays[name].grad.numpy(), rtol=1e-12, atol=1e-12 * scale + 1e-20
        )
    once = tensors["receivers"].grad.clone()
    loss.backward()  # a second one adds the same again
    assert once.abs().max() > 0 and torch.equal(tensors["receivers"].grad, 2 * once)


def test_torch_refuses_second_derivatives_and_takes_single_precision():
    held = wr.paths.trace_specular(room(), receivers=RX[0], **ASKED)
    at = torch.tensor(RX[0], dtype=torch.float32, requires_grad=True)
    tau = held.evaluate(receivers=at).tau.square().sum()
    slope = torch.autograd.grad(tau, at, create_graph=True)[0]
    assert slope.dtype == torch.float32
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()


@pytest.mark.parametrize("ends", [([0, 0, 2.0], [0, 0, 1.0]), ([0.5, 0, 1.5], [-0.5, 0, 1.5])])
def test_slopes_of_paths_that_meet_mirrors_head_on_are_numbers(ends):
    """From above each other, where the azimuth is none, and to walls straight ahead."""
    tx, rx = map(np.array, ends)
    held = wr.paths.trace_specular(room(), **(ASKED | {"transmitter": tx}), receivers=rx)
    at, start = torch.tensor(rx, requires_grad=True), torch.tensor(tx, requires_grad=True)
    found = held.evaluate(receivers=at, transmitter=start)
    found.gain.abs().square().sum().backward()
    assert torch.isfinite(at.grad).all() and torch.isfinite(start.grad).all()

    def power(place):
        return (np.abs(held.evaluate(receivers=place).gain) ** 2).sum()

    step = np.array([3e-6, 1e-6, 2e-6])
    expected = (power(rx + step) - power(rx - step)) / 2
    assert abs(float(at.grad.numpy() @ step) - expected) < 1e-6 * abs(expected)


def test_a_bare_mesh_has_ends_and_no_materials():
    held = wr.paths.trace_specular(room().mesh, receivers=RX, transmitter=TX, frequency_hz=F)
    same_but_jones = wr.trace_paths(room().mesh, receivers=RX, transmitter=TX, frequency_hz=F)
    np.testing.assert_array_equal(held.evaluate().gain, same_but_jones.gain[same_but_jones.valid])
    with pytest.raises(ValueError, match=r"scattering: got shape \(2,\), expected \(0,\)"):
        held.evaluate(scattering=[0.1, 0.1])


def test_no_paths_are_no_numbers():
    held = wr.paths.trace_specular(
        room(), transmitter=TX, receivers=[2.2, -0.7, 1.2], frequency_hz=F, mirror_order=0
    )
    assert len(held) == 0 and held.evaluate().gain.shape == (0,)
    at = torch.tensor([2.2, -0.7, 1.2], dtype=torch.float64, requires_grad=True)
    held.evaluate(receivers=at).tau.sum().backward()
    assert not at.grad.any()


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("receivers", RX[0], r"receivers: got shape \(1, 3\), expected \(3, 3\)"),
        ("receivers", np.full((3, 3), np.nan), "receivers: got 9 values that are NaN"),
        ("receivers", np.tile(TX, (3, 1)), "receivers: got places that"),
        ("transmitter", RX, r"transmitter: got shape \(3, 3\), expected \(1, 3\)"),
        ("receiver_orientation", np.zeros((2, 3)), r"expected \(1, 3\) or \(3, 3\)"),
        ("relative_permittivity", [0.5, 2.0], "relative_permittivity: got 0.5 to 2, expected 1 to"),
        ("thickness_m", [0.1, np.nan], "thickness_m: got nan to nan"),
        ("scattering", torch.tensor([0.1, 1.5]), "scattering: got 0.1 to 1.5, expected 0 to 1"),
        ("conductivity", wp.zeros(2, dtype=wp.float32, device="cpu"), "expected a Warp array of float64"),
    ],
)
def test_what_is_no_parameter_is_refused(name, value, words):
    held = wr.paths.trace_specular(room(), receivers=RX, **ASKED)
    with pytest.raises(ValueError, match=words):
        held.evaluate(**{name: value})


def test_warp_and_torch_do_not_mix_and_there_is_one_transmitter():
    held = wr.paths.trace_specular(room(), receivers=RX, **ASKED)
    with pytest.raises(TypeError, match="receivers, scattering: got arrays of Warp and of torch"):
        held.evaluate(receivers=torch.tensor(RX), scattering=wp.zeros(2, dtype=wp.float64, device="cpu"))
    with pytest.raises(ValueError, match=r"transmitter: got shape \(3, 3\)"):
        wr.paths.trace_specular(room(), receivers=RX, **(ASKED | {"transmitter": RX}))


def test_retraced_slopes_see_the_edge_of_a_shadow_that_frozen_ones_do_not():
    """A sheet hides the transmitter beyond y = 0.8: over 1 cm to either side the total falls by what line of sight carried."""
    sheet = np.array([[0.0, 0.4, 0.0], [0.0, 3.0, 0.0], [0.0, 3.0, 3.0], [0.0, 0.4, 3.0]]), PANE[1]
    mesh, part = joined(([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]], PANE[1]), sheet)
    scene = wr.Scene(mesh, [ROUGH, GLASS], part)
    asked = {"transmitter": [-2.0, 0.0, 1.5], "frequency_hz": 300e9}

    def total_db(at):
        return 10 * np.log10(wr.trace_paths(scene, receivers=at, **asked).power.sum(axis=1) + 1e-30)

    away, edge = np.array([[2.0, -1.0, 1.0], [2.0, 0.8, 1.0]])
    retraced = retraced_slope(total_db, [away, edge])
    at = torch.tensor(np.array([away, edge - [0, 1e-3, 0]]), requires_grad=True)
    power = (
        wr.paths.trace_specular(scene, receivers=at.detach(), **asked)
        .evaluate(receivers=at)
        .gain.abs()
        .square()
    )
    held = wr.paths.trace_specular(scene, receivers=at.detach(), **asked)
    total = torch.zeros(2, dtype=torch.float64).index_add(0, torch.as_tensor(held.receiver), power)
    (10 * total.log10()).sum().backward()
    np.testing.assert_allclose(retraced[0], at.grad[0], rtol=1e-3, atol=1e-4)
    assert abs(retraced[1, 1]) > 1000 and at.grad[1].abs().max() < 10


def test_a_retraced_slope_is_a_central_difference():
    slope = retraced_slope(
        lambda at: np.stack([at @ [1, 2, 3], (at**2).sum(axis=1)], axis=1), [1.0, 2.0, 3.0]
    )
    np.testing.assert_allclose(slope, [[1, 2, 3], [2, 4, 6]], rtol=1e-12)
    assert retraced_slope(lambda at: at[:, 0], np.ones((5, 3)), step_m=0.5).shape == (5, 3)
    with pytest.raises(ValueError, match="answer: got shape"):
        retraced_slope(lambda at: 0.0, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="step_m"):
        retraced_slope(lambda at: at, [1.0, 2.0, 3.0], step_m=0)


def test_a_pickle_brings_back_what_answers_the_same():
    held = wr.paths.trace_specular(room(), receivers=RX, **ASKED)
    again = pickle.loads(pickle.dumps(held))
    np.testing.assert_array_equal(again.receiver, held.receiver)
    moved = RX + 0.001
    np.testing.assert_array_equal(again.evaluate(receivers=moved).gain, held.evaluate(receivers=moved).gain)
    assert (
        repr(again) == repr(held) == f"SpecularPaths({len(held)} to {len(RX)} receivers at {F / 1e9:g} GHz)"
    )
