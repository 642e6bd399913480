"""How coarse a lossy WebP is, by the header of its one VP8 frame (RFC 6386, 9.3 to 9.6 and 19.2)."""

FRAME_HEADER = 10  # bytes before the coded header: the frame's tag, its start code and its size
SEGMENTS, COARSEST = 4, 127


def quality(frame: bytes) -> float:
    """The quality, 0 to 100, at which libwebp quantises so or, where segments differ, a little finer.

    Raises ``IndexError`` for a frame that is cut off.
    """
    index = min(max(_mean_index(_Bits(frame[FRAME_HEADER:])), 0), COARSEST)
    fineness = (1 - index / COARSEST) ** 3  # libwebp's own curve, turned round
    return 100 * min(1.5 * fineness, (1 + fineness) / 2)


class _Bits:
    """Numbers out of a stream whose bits are arithmetically coded, each as likely as not (RFC 6386, 7.3)."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 2
        self._value, self._range, self._shifts = data[0] << 8 | data[1], 255, 0

    def number(self, bits: int = 1) -> int:
        found = 0
        for _ in range(bits):
            found = found << 1 | self._bit()
        return found

    def signed(self, bits: int) -> int:
        """A number that is 0 where its flag is not set, and has its sign behind it."""
        if not self.number():
            return 0
        size = self.number(bits)
        return -size if self.number() else size

    def _bit(self) -> int:
        split = 1 + (self._range - 1 >> 1)
        found = self._value >= split << 8
        self._range = self._range - split if found else split
        self._value -= found * split << 8
        while self._range < 128:
            self._value, self._range, self._shifts = self._value << 1, self._range << 1, self._shifts + 1
            if self._shifts % 8 == 0:
                self._value |= self._data[self._at]
                self._at += 1
        return int(found)


def _mean_index(bits: _Bits) -> float:
    """Of the steps of luminance, over the segments that the frame has of its own."""
    bits.number(2)  # colour space, clamping
    segments, is_absolute = _segments(bits) if bits.number() else ([0], False)
    bits.number(10)  # the filter's kind, level and sharpness
    if bits.number() and bits.number():
        for _ in range(8):
            bits.signed(6)
    bits.number(2)  # how many partitions
    base = bits.number(7)
    return sum(segments) / len(segments) + (0 if is_absolute else base)


def _segments(bits: _Bits) -> tuple[list[int], bool]:
    """Each segment's index, and whether that stands for itself or is added to the frame's."""
    segments, is_absolute = [0], False
    has_map = bits.number()
    if bits.number():
        is_absolute = bool(bits.number())
        segments = [bits.signed(7) for _ in range(SEGMENTS)]
        for _ in range(SEGMENTS):
            bits.signed(6)  # of the filter
    for _ in range(3 * has_map):
        if bits.number():
            bits.number(8)
    return segments, is_absolute
