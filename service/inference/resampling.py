"""Maps at any pixel of the photograph: bilinear, with pixel centres where the conventions put them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Axis:
    """For each pixel of the photograph along one axis: the map's pixel before it, that after, its share."""

    before: NDArray[np.intp]
    after: NDArray[np.intp]
    share: NDArray[np.float32]

    @classmethod
    def between(cls, photograph_px: int, working_px: int, stride: int, map_px: int) -> "Axis":
        """From a photograph to a copy resized to ``working_px`` whose map has one pixel per ``stride``.

        Centres follow from areas: u of the photograph lies at (u + 1/2) * ratio - 1/2 of the map.
        """
        ratio = working_px / (photograph_px * stride)
        at = np.clip((np.arange(photograph_px) + 0.5) * ratio - 0.5, 0, map_px - 1)
        before = np.floor(at).astype(np.intp)
        return cls(before, np.minimum(before + 1, map_px - 1), (at - before).astype(np.float32))

    def part(self, start: int, stop: int) -> "Axis":
        return Axis(self.before[start:stop], self.after[start:stop], self.share[start:stop])


def sample(values: NDArray[np.float32], rows: Axis, columns: Axis) -> NDArray[np.float32]:
    """The map [h, w] at every crossing of the axes: float32 [len(rows), len(columns)]."""
    first = int(rows.before[0])
    band = values[first : int(rows.after[-1]) + 1]
    # along the last axis first: the band has fewer rows than the photograph
    wide = _between(band.take(columns.before, axis=1), band.take(columns.after, axis=1), columns.share)
    return _between(wide[rows.before - first], wide[rows.after - first], rows.share[:, np.newaxis])


def _between(
    before: NDArray[np.float32], after: NDArray[np.float32], share: NDArray[np.float32]
) -> NDArray[np.float32]:
    """``before`` moved by ``share`` towards ``after``, in place of both."""
    after -= before
    after *= share
    before += after
    return before
