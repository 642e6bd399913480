"""The picture of a calibration, read as a browser draws it: what is lower has the larger y."""

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Barrier

from service.calibration.plot import as_svg
from service.calibration.report import CurvePoint, Result, Sample
from tests.fake_calibration import RESULT


def circle(number: int, depth_m: float, blur_px: float, v_px: float, *, used: bool = True) -> Sample:
    return Sample(number, "near.png", 20.0, v_px, depth_m, blur_px, 0.05, 6.5 if used else None, used=used)


NEAR, MIDDLE, FAR, ODD = (
    *(circle(0, 0.5, 6.0, 5.0), circle(1, 1.0, 3.0, 20.0), circle(2, 4.0, 1.0, 40.0)),
    circle(3, 1.0, 9.0, 40.0, used=False),
)
DRAWN = replace(
    RESULT,
    samples=(NEAR, MIDDLE, FAR, ODD),
    curve=(CurvePoint(0.5, 6.0, 5.5, 6.5), CurvePoint(4.0, 1.0, 0.8, 1.2)),
)


def dots(result: Result, axes: int) -> list[list[tuple[float, float]]]:
    """Where each scatter plot of one of the three has its points, from the left and from the top."""
    drawn = as_svg(result).decode().partition(f'<g id="axes_{axes}">')[2]
    plot = re.split(r'<g id="(?:axes|legend)_', drawn)[0]
    scatters = re.findall(r'<g id="PathCollection_\d+">(.*?)\n   </g>', plot, re.DOTALL)
    return [[(float(x), float(y)) for x, y in re.findall(r' x="(.*?)" y="(.*?)"', each)] for each in scatters]


def test_what_is_nearer_is_to_the_right_and_what_is_blurrier_is_higher_up() -> None:
    (odd,), (near, middle, far) = dots(DRAWN, 1)
    assert far[0] < middle[0] < near[0]
    assert far[1] > middle[1] > near[1] > odd[1]
    assert odd[0] == middle[0]


def test_what_was_left_out_is_told_apart_where_there_is_any() -> None:
    assert b"outliers" in as_svg(DRAWN)
    assert b"outliers" not in as_svg(replace(DRAWN, samples=(NEAR, MIDDLE, FAR)))


def test_the_frame_is_upright() -> None:
    (places,) = dots(DRAWN, 3)
    assert [y for _, y in places] == sorted(y for _, y in places)


def test_threads_draw_the_same_and_open_no_fonts_of_their_own() -> None:
    alone, together = as_svg(DRAWN), Barrier(8)
    files = Path("/proc/self/fd")
    before = len(list(files.iterdir()))

    def drawn(_: int) -> bytes:
        together.wait()
        return as_svg(DRAWN)

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(drawn, range(8))) == {alone}
    assert len(list(files.iterdir())) <= before
