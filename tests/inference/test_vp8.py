"""The quality of a lossy WebP, out of headers that are written bit by bit."""

import pytest

from service.inference.vp8 import quality

Field = tuple[int, int]  # a number and its bits
NO: Field = (0, 1)


def frame(*fields: Field) -> bytes:
    """A frame of these numbers, coded as RFC 6386, 7.3 has it, each bit as likely as not."""
    low, size, shifts = 0, 255, 0
    for number, bits in fields:
        for at in reversed(range(bits)):
            split = 1 + (size - 1 >> 1)
            low, size = (low + split, size - split) if number >> at & 1 else (low, split)
            while size < 128:
                low, size, shifts = low << 1, size << 1, shifts + 1
    low <<= 32
    return bytes(10) + (low << -(shifts + 8) % 8).to_bytes(-(-(shifts + 40) // 8), "big")


def signed(number: int, bits: int) -> tuple[Field, Field, Field]:
    return (1, 1), (abs(number), bits), (int(number < 0), 1)


def segments(is_absolute: int, *indices: int) -> list[Field]:
    """Of a frame that says which place is of which segment, and how the filter differs in two of them."""
    quantisers = [field for index in indices for field in signed(index, 7)]
    return [(1, 1), (1, 1), (1, 1), (is_absolute, 1), *quantisers, NO, *signed(-3, 6), NO, *signed(9, 6), *chances()]


def chances() -> list[Field]:
    return [(1, 1), (200, 8), NO, (1, 1), (17, 8)]


FILTER: list[Field] = [(1, 1), (46, 6), (5, 3)]
FILTER_CHANGES: list[Field] = [(1, 1), (1, 1), *signed(2, 6), NO, *signed(-2, 6), *[NO] * 5]


@pytest.mark.parametrize(
    ("told", "index"),
    [
        ([NO], 40),
        ([(1, 1), NO, NO], 40),
        ([(1, 1), (1, 1), NO, *chances()], 40),
        (segments(1, 30, 20, 10, 0), 15),
        (segments(0, 8, -8, -20, 0), 35),
        (segments(0, -127, -127, -127, -127), 0),
        (segments(1, 127, 127, 127, 127), 127),
    ],
)
@pytest.mark.parametrize("changes", [[NO], [(1, 1), NO], FILTER_CHANGES])
def test_the_quality_is_that_of_the_mean_step_of_luminance(told: list[Field], index: int, changes: list[Field]) -> None:
    written = frame((0, 2), *told, *FILTER, *changes, (3, 2), (40, 7))
    fineness = (1 - index / 127) ** 3
    assert quality(written) == pytest.approx(100 * min(1.5 * fineness, (1 + fineness) / 2))


def test_libwebp_s_default_is_its_quality_of_75() -> None:
    assert quality(frame((0, 2), NO, *FILTER, NO, (0, 2), (26, 7))) == pytest.approx(75, abs=0.5)


def test_a_frame_that_is_cut_off_is_no_endless_one() -> None:
    with pytest.raises(IndexError):
        quality(frame((0, 2), *segments(1, 3, 2, 1, 0))[:14])
