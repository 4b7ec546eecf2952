"""Argument checks: what is no number of the kind that is asked for is refused by the argument's name."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from warprrf.checks import check_array, check_count, check_number, check_positive, check_type
from warprrf.geometry.mesh import Mesh

NO_NUMBERS = [
    None, "three", "3", b"3", [1.0, 2.0], [[1], [2, 3]], {}, object(), 1j, float("nan"), float("inf"), -1, 10**400,
]  # fmt: skip


@pytest.mark.parametrize("value", NO_NUMBERS, ids=lambda value: repr(value)[:20])
def test_a_number_is_finite_real_and_within_its_range(value: object) -> None:
    for check in (check_count, check_positive, lambda name, v: check_number(name, v, 0.0, 9.0)):
        with pytest.raises(ValueError, match=r"^size: got "):
            check("size", value)


def test_numbers_of_any_kind_are_taken() -> None:
    assert check_count("n", np.uint8(3), 0, 3) == 3
    kinds = (3, 0.5, np.float32(0.25), Fraction(1, 8))
    assert [check_positive("x", v) for v in kinds] == [3.0, 0.5, 0.25, 0.125]
    assert check_number("x", -2, -2.0, -2.0) == -2.0
    for wrong in (4, True):
        with pytest.raises(ValueError, match=r"whole number of 0 to 3"):
            check_count("n", wrong, 0, 3)


@pytest.mark.parametrize("value", [[1.5, 2.0], [np.nan, 1.0], [2**40, 1], [2**80, 1], [1e30, 1.0]])
def test_indices_are_neither_rounded_nor_wrapped(value: list[float]) -> None:
    with pytest.raises(TypeError, match=r"^face: got .*int32"):
        check_array("face", value, (2,), dtype=np.int32)
    with pytest.raises(TypeError, match=r"^faces: got "):
        Mesh(np.eye(3), [[0, *value]])


def test_arrays_keep_their_values() -> None:
    np.testing.assert_array_equal(check_array("i", [1.0, 2.0], (None,), dtype=np.int32), [1, 2])
    np.testing.assert_array_equal(check_array("z", [1, 1j], (2,), dtype=complex), [1, 1j])
    np.testing.assert_array_equal(check_array("x", [np.nan], (1,), finite=False), [np.nan])
    assert check_array("x", 3, ()).shape == ()
    assert check_array("x", np.asfortranarray(np.ones((2, 3)))).flags.c_contiguous
    for wrong in ([1j * np.nan], [np.inf]):
        with pytest.raises(ValueError, match=r"^z: got 1 values that are NaN"):
            check_array("z", wrong, dtype=complex)
    with pytest.raises(ValueError, match=r"^x: got 1 values"):
        check_array("x", 1e300, (), np.float32)


def test_a_wrong_type_says_what_came() -> None:
    check_type("mesh", Mesh(np.eye(3), [[0, 1, 2]]), Mesh)
    with pytest.raises(TypeError, match=r"^mesh: got NoneType, expected a Mesh; load one$"):
        check_type("mesh", None, Mesh, "; load one")
