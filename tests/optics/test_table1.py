"""Table 1 of the paper, row by row, from the formula and the constants that the paper used without saying so."""

import pytest

from service.optics.thin_lens import k_cam

K_R_OF_TABLE = 2**-0.5
FOCUS_M = 2.0
TOLERANCE = 0.003
T7, D7500, A7IV = 3.72, 4.19, 5.11

ROWS = [
    (T7, 18, 4, 15.54),
    (T7, 55, 5.6, 105.58),
    (T7, 50, 1.2, 406.16),
    (T7, 70, 5.6, 172.35),
    (D7500, 50, 1.8, 240.40),
    (D7500, 18, 3.5, 15.76),
    (D7500, 18, 5.6, 9.85),
    (D7500, 55, 3.5, 149.98),
    (D7500, 55, 5.6, 93.73),
    (A7IV, 16, 4, 8.92),
    (A7IV, 35, 4, 43.13),
    (A7IV, 16, 22, 1.62),
    (A7IV, 70, 2.8, 250.94),
    (A7IV, 200, 2.8, 2196.48),
    (A7IV, 70, 22, 31.93),
]


@pytest.mark.parametrize(("pitch_um", "focal_mm", "f_number", "printed"), ROWS)
def test_row_is_reproduced(pitch_um: float, focal_mm: float, f_number: float, printed: float) -> None:
    k = k_cam(focal_mm * 1e-3, f_number, FOCUS_M, pitch_um * 1e-6, 1.0, K_R_OF_TABLE)
    assert k == pytest.approx(printed, rel=TOLERANCE)


PIXEL_ROWS = [
    # equivalent focal length, f-number, pitch, ratio of pixel counts, printed, real focal length
    (25.0, 1.85, 1.2, 0.25, 50.39, 6.81),
    (120.0, 2.55, 0.7, 0.26, 1577.82, 19.0),
]


@pytest.mark.parametrize(("equivalent_mm", "f_number", "pitch_um", "count_ratio", "printed", "real_mm"), PIXEL_ROWS)
def test_pixel_rows_come_only_of_two_mistakes(
    equivalent_mm: float, f_number: float, pitch_um: float, count_ratio: float, printed: float, real_mm: float
) -> None:
    """They take a 35-mm-equivalent for the focal length and a ratio of pixel counts for one of widths."""
    mistaken = k_cam(equivalent_mm * 1e-3, f_number, FOCUS_M, pitch_um * 1e-6, count_ratio, K_R_OF_TABLE)
    assert mistaken == pytest.approx(printed, rel=TOLERANCE)
    real = k_cam(real_mm * 1e-3, f_number, FOCUS_M, pitch_um * 1e-6, count_ratio**0.5, K_R_OF_TABLE)
    assert mistaken / real > 6
