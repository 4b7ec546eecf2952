"""Blending weights on disk: what rounding does to them, resuming, and that a fit from disk is the fit from memory."""

import numpy as np
import pytest

from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.render import blend_weights
from warprrf.rf.fields import files as field_files
from warprrf.rf.fields.harmonic import store
from warprrf.rf.fields.harmonic.batches import Problem
from warprrf.rf.fields.harmonic.fitting import Target, fit_layer
from warprrf.rf.fields.harmonic.interaction import interaction_points
from warprrf.rf.fields.harmonic.store import StoredTransport, store_transport
from warprrf.rf.fields.harmonic.targets import weighted_means
from warprrf.rf.fields.harmonic.transport import cutoffs, transport

SHAPE = (12, 24)
RECEIVERS = np.random.default_rng(0).uniform(-0.5, 0.5, (23, 3))


def cloud(n=400, seed=1):
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(n, 3))
    means[: n // 2] = 2.5 * means[: n // 2] / np.linalg.norm(means[: n // 2], axis=1, keepdims=True)
    means[n // 2 :, 2] = np.abs(means[n // 2 :, 2]) + 0.6  # below them some rays meet nothing
    return Gaussians(
        means,
        rng.normal(size=(n, 4)),
        np.exp(rng.uniform(np.log(0.05), np.log(0.2), (n, 3))),
        rng.uniform(0.05, 1, n),
        np.zeros((n, 1, 3)),
    )


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("store")
    g = cloud()
    return (
        g,
        transport(g, RECEIVERS, SHAPE, top_k=6, device="cpu"),
        store_transport(folder, g, RECEIVERS, SHAPE, top_k=6, device="cpu"),
    )


def test_stored_weights_are_those_in_memory_to_a_thousandth(both):
    _, memory, stored = both
    back = stored.subset(range(len(RECEIVERS)))
    assert (memory.dominant < 0).any() and (np.diff(memory.start) == 6).any()
    assert np.array_equal(back.start, memory.start) and np.array_equal(back.gaussian, memory.gaussian)
    np.testing.assert_allclose(back.weight, memory.weight, rtol=2.0**-10)
    assert np.abs(back.weight / memory.weight - 1).max() > 1e-5  # it is rounded
    np.testing.assert_allclose(back.pixel_weight, memory.pixel_weight, rtol=1e-6)
    np.testing.assert_allclose(stored.pixel_weight, memory.pixel_weight, rtol=1e-6)
    for name in ("dominant", "expected_range", "seen", "receivers"):
        np.testing.assert_array_equal(getattr(stored, name), getattr(memory, name))
    assert (stored.pairs, stored.shape, stored.rule) == (memory.pairs, memory.shape, memory.rule)
    np.testing.assert_allclose(stored.dropped, memory.dropped, rtol=1e-3)


def test_what_the_limit_dropped_is_what_more_places_would_have_held(both):
    g, memory, stored = both
    view = blend_weights(
        g,
        Camera.spherical(SHAPE[1], SHAPE[0], position=RECEIVERS[3]),
        top_k=400,
        blending=cutoffs((-60, 0)),
        device="cpu",
    )
    lost = np.maximum(view.alpha - np.sort(view.weight, axis=2)[..., -6:].sum(axis=2), 0)
    part = stored.at(RECEIVERS[3])
    assert lost.max() > 0.01
    assert part.dropped[0] == pytest.approx(lost.max(), rel=2e-3)
    assert part.dropped[1] == pytest.approx(lost.mean(), rel=2e-3)


def test_parts_and_single_receivers_cover_everything(both):
    _, memory, stored = both
    parts = list(stored.parts())
    assert [len(chosen) for chosen, _ in parts] == [10, 10, 3]
    assert np.array_equal(np.concatenate([p.gaussian for _, p in parts]), memory.gaussian)
    assert np.array_equal(stored.at(RECEIVERS[7]).gaussian, memory.at(RECEIVERS[7]).gaussian)
    with pytest.raises(ValueError, match="none of the 23"):
        stored.at([9, 9, 9])


@pytest.mark.parametrize("kind", ["centre", "peak", "expected"])
def test_interaction_points_are_the_same_from_both(both, kind):
    g, memory, stored = both
    np.testing.assert_array_equal(interaction_points(memory, g, kind), interaction_points(stored, g, kind))


def test_a_fit_from_disk_is_bit_for_bit_the_fit_from_memory(both):
    _, _, stored = both
    memory = stored.subset(range(len(RECEIVERS)))
    rng = np.random.default_rng(2)
    shape = (len(RECEIVERS), *SHAPE)
    image, where = rng.uniform(0.1, 0.9, shape), rng.random(shape) < 0.8
    means = [weighted_means(t, image, where) for t in (memory, stored)]
    assert np.array_equal(means[0][0], means[1][0])
    np.testing.assert_allclose(means[0][1], means[1][1], rtol=1e-12)
    coefficients = []
    for source in (memory, stored, stored):  # the third finds the files of the second
        problem = Problem(source, batch=5, seed=4, device="cpu")
        target = Target(
            image=image,
            initial=np.zeros(len(problem.seen)),
            unit=rng.uniform(1, 1, len(problem.seen)),
            factor=np.full(shape, 20.0),
            extra=np.zeros(shape),
            high=40.0,
        )
        coefficients.append(fit_layer(problem, target, "exp", steps=7).coefficients)
    assert np.abs(coefficients[0]).max() > 0.1
    assert np.array_equal(coefficients[0], coefficients[1])
    assert np.array_equal(coefficients[0], coefficients[2])


def test_a_killed_run_goes_on_and_ends_with_the_same_numbers(tmp_path, monkeypatch):
    g, done = cloud(80), []
    whole = store_transport(tmp_path / "whole", g, RECEIVERS[:5], SHAPE, device="cpu")

    def stop_after_two(stage, step, total):
        if step == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store_transport(tmp_path / "cut", g, RECEIVERS[:5], SHAPE, device="cpu", progress=stop_after_two)
    with pytest.raises(ValueError, match="3 of 5 receivers are missing"):
        StoredTransport(tmp_path / "cut")
    encode = store._encoded
    monkeypatch.setattr(store, "_encoded", lambda view, k: done.append(1) or encode(view, k))
    store_transport(tmp_path / "cut", g, RECEIVERS[:5], SHAPE, device="cpu")
    assert len(done) == 3
    for file in sorted(whole.folder.iterdir()):
        one, other = (field_files.read(f, store.FORMAT) for f in (file, tmp_path / "cut" / file.name))
        assert one[1] == other[1] and one[0].keys() == other[0].keys()
        for name, values in one[0].items():
            assert values.tobytes() == other[0][name].tobytes()
    assert not list(tmp_path.rglob("*partial*"))


def test_a_store_of_something_else_is_refused(both):
    g, _, stored = both
    for change in (
        {"receivers": RECEIVERS + 0.01},
        {"range_db": (-50, 0)},
        {"top_k": 5},
        {"gaussians": cloud(seed=2)},
    ):
        arguments = {"gaussians": g, "receivers": RECEIVERS, "shape": SHAPE, "top_k": 6, **change}
        with pytest.raises(ValueError, match="folder: .* other geometry, receivers or options"):
            store_transport(stored.folder, **arguments, device="cpu")
    with pytest.raises(FileNotFoundError):
        StoredTransport(stored.folder / "nowhere")


def test_a_file_of_another_store_is_noticed(tmp_path):
    first = store_transport(tmp_path / "a", cloud(50), RECEIVERS[:2], SHAPE, device="cpu")
    other = store_transport(tmp_path / "b", cloud(50, seed=3), RECEIVERS[:2], SHAPE, device="cpu")
    name = "receiver_00001.safetensors"
    (first.folder / name).write_bytes((other.folder / name).read_bytes())
    with pytest.raises(ValueError, match="belongs to another store"):
        StoredTransport(first.folder).subset([1])
    (first.folder / name).write_bytes(b"cut short")
    with pytest.raises(ValueError, match="corrupt"):
        StoredTransport(first.folder).subset([1])


def test_more_gaussians_a_pixel_than_a_byte_counts(tmp_path):
    rng = np.random.default_rng(5)
    n = 300
    g = Gaussians(
        np.column_stack([np.linspace(1, 3, n), 0.01 * rng.normal(size=(n, 2))]),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), 0.3),
        np.full(n, 0.01),
        np.zeros((n, 1, 3)),
    )
    memory = transport(g, np.zeros((1, 3)), SHAPE, top_k=300, device="cpu")
    stored = store_transport(tmp_path, g, np.zeros((1, 3)), SHAPE, top_k=300, device="cpu")
    back = stored.subset([0])
    assert np.diff(memory.start).max() > 255
    assert np.array_equal(back.gaussian, memory.gaussian) and np.array_equal(back.dominant, memory.dominant)
