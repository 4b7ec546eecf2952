"""Annotations hold: what an argument may be is checked by its name before the body sees it."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest

from warprrf.checks import NotNegative, Shaped, check_array, check_items, checked, one_of, warn, whole


@checked
@dataclass(frozen=True)
class Measured:
    places: Annotated[np.ndarray, Shaped("R 3")]
    power: Annotated[np.ndarray, Shaped("R", np.float32)] | None = None
    step: Annotated[int, whole(2, 4)] = 9  # a default is taken as it is
    error: NotNegative | None = None
    how: Annotated[str, one_of("a", "b")] = "a"


def test_what_an_annotation_allows_comes_as_it_says():
    found = Measured([[1, 2, 3]], step=np.int64(3), error=np.float32(0.5), how="b")
    assert found.places.dtype == np.float64 and found.places.shape == (1, 3)
    assert (type(found.step), type(found.error)) == (int, float)
    assert Measured([[1, 2, 3]]).step == 9


@pytest.mark.parametrize(
    ("told", "given"),
    [
        (r"^places: got shape \(2,\), expected \(any, 3\)$", {"places": [1, 2]}),
        (r"^places: .*NaN", {"places": [[0, 0, np.nan]]}),
        (r"^step: got an array of object, expected int$", {"step": np.array([object()])}),
        (r"^step: got 5, expected a whole number of 2 to 4$", {"step": 5}),
        (r"^step: got float 2.5, expected int$", {"step": 2.5}),
        (r"^error: got -1, expected a finite number of at least 0$", {"error": -1}),
        (r"^error: got str 'x', expected float \| None$", {"error": "x"}),
        (r"^how: got 'c', expected one of a, b$", {"how": "c"}),
    ],
)
def test_what_it_does_not_allow_is_refused_by_name(told, given):
    with pytest.raises((TypeError, ValueError), match=told):
        Measured(**({"places": [[1, 2, 3]]} | given))


def test_values_under_a_mask_are_not_taken_for_measured_ones():
    read = np.ma.masked_equal([[1.0, 2.0, -999.0]], -999.0)  # as netCDF4 gives them
    for take in (Measured, lambda values: check_array("places", values)):
        with pytest.raises(ValueError, match="^places: got a masked array with 1 masked values"):
            take(read)
        take(np.ma.masked_equal([[1.0, 2.0, 3.0]], -999.0))


def test_arrays_of_one_call_share_sizes_in_whatever_order_they_come():
    @checked
    def both(
        a: Annotated[np.ndarray, Shaped("N 2")], b: Annotated[np.ndarray, Shaped("N", least=0.0)]
    ) -> int:
        return len(a) + len(b)

    assert both([[1, 2], [3, 4]], b=[0, 1]) == both(b=[0, 1], a=[[1, 2], [3, 4]]) == 4
    for call in (lambda: both([[1, 2]], [0, 1]), lambda: both(b=[0, 1], a=[[1, 2]])):
        with pytest.raises(ValueError, match=r"^b: got shape \(2,\), expected \(1\)$"):
            call()


def test_an_item_of_another_kind_is_named():
    assert check_items("names", ("a", "b"), str) == ["a", "b"]
    with pytest.raises(TypeError, match=r"^names\[1\]: got int"):
        check_items("names", ["a", 1], str)
    with pytest.raises(ValueError, match="^names: got none, expected at least 1"):
        check_items("names", [], str, 1)


def test_a_warning_points_at_the_line_that_called_the_library():
    with pytest.warns(UserWarning, match="^mind$") as found:
        warn("mind")
    assert found[0].filename == __file__
