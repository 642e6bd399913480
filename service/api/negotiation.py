"""Which form of answer a request asks for: ``format`` wins, then ``Accept`` with its q-values."""

from collections.abc import Mapping

from service.errors import NotAcceptable


def choose_format(asked: str | None, accept: str | None, media_types: Mapping[str, str]) -> str:
    """A key of ``media_types``, which maps formats to media types, the preferred first.

    Raises ``NotAcceptable`` where ``Accept`` fits none.
    """
    if asked is not None:
        return asked
    ranges = _media_ranges(accept or "*/*")
    qualities = {name: _quality(media_type, ranges) for name, media_type in media_types.items()}
    best = max(qualities, key=lambda name: qualities[name])
    if qualities[best] <= 0:
        offered = ", ".join(dict.fromkeys(media_types.values()))
        raise NotAcceptable(f"No format fits this Accept header: ask for one of {offered}.")
    return best


def _media_ranges(accept: str) -> dict[str, float]:
    """q by media range; a range whose q is no number between 0 and 1 is left out."""
    ranges: dict[str, float] = {}
    for item in accept.split(","):
        name, *parameters = (part.strip().lower() for part in item.split(";"))
        told = next((part[2:] for part in parameters if part.startswith("q=")), "1")
        try:
            quality = float(told)
        except ValueError:
            continue
        if name and 0 <= quality <= 1:
            ranges[name] = quality
    return ranges


def _quality(media_type: str, ranges: Mapping[str, float]) -> float:
    """The q of the most specific range that fits."""
    family = media_type.partition("/")[0] + "/*"
    return next((ranges[name] for name in (media_type, family, "*/*") if name in ranges), 0.0)
