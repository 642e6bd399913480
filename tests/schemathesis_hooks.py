"""What Schemathesis sends as photographs: real ones, whole and damaged, and bytes that never were one."""

import schemathesis
from hypothesis import strategies as st

from tests.inference import photographs

# the size of the camera that the tests register, the same frame made smaller, and another frame
SIZES = ((30, 40), (15, 20), (17, 40))
MADE = {
    "image/jpeg": [photographs.jpeg(photographs.corners(*size)) for size in SIZES],
    "image/png": [photographs.png(photographs.corners(*size), orientation=1) for size in SIZES],
    "image/tiff": [photographs.tiff(photographs.corners(*size)) for size in SIZES],
    "image/webp": [photographs.webp(photographs.corners(*size)) for size in SIZES],
    "image/avif": [photographs.avif(photographs.corners(*size)) for size in SIZES],
}
EVERY = [body for bodies in MADE.values() for body in bodies]


@st.composite
def damaged(draw: st.DrawFn, bodies: list[bytes]) -> bytes:
    """A photograph that is cut off, or some of whose bytes are others."""
    body = bytearray(draw(st.sampled_from(bodies)))
    places = st.tuples(st.integers(0, len(body) - 1), st.integers(0, 255))
    for place, value in draw(st.lists(places, max_size=8)):
        body[place] = value
    return bytes(body[: draw(st.integers(1, len(body)))])


for media_type, bodies in MADE.items():
    # twice, for a photograph of the right kind is what gets furthest
    whole = st.sampled_from(bodies)
    photograph = st.one_of(whole, whole, damaged(bodies), st.sampled_from(EVERY), st.binary(max_size=64))
    schemathesis.openapi.media_type(media_type, photograph)
for media_type in ("image/heic", "image/heif"):
    # the decoder is an extra, and nothing here writes the kind
    schemathesis.openapi.media_type(media_type, st.one_of(st.sampled_from(EVERY), st.binary(max_size=64)))
