"""Metres in words."""

import pytest

from service.metres import in_words


@pytest.mark.parametrize(
    ("depth_m", "words"),
    [(2.0, "2.000"), (0.5, "0.500"), (0.4567891, "0.4568"), (0.1, "0.1000"), (0.012345, "0.01235"), (123.4, "123.400")],
)
def test_what_is_close_has_four_digits_and_all_else_millimetres(depth_m: float, words: str) -> None:
    assert in_words(depth_m) == words


def test_an_error_has_as_many_decimals_as_its_depth() -> None:
    assert in_words(0.0004567, 0.0123) == "0.00046"
    assert in_words(0.3, 2.0) == "0.300"
