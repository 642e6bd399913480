"""A calibration as a picture: the measured circles, and the curve fitted through them."""

from service.calibration.report import Result


def as_svg(result: Result) -> bytes:
    """Blur against distance, as an SVG document."""
    raise NotImplementedError
