"""A photograph and its camera to depth: chooses the scale, reads, decides. No answer depends on another."""

import math
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from service.inference.artifact import Interval, Manifest, ModelFolder
from service.inference.border import Mask, black_border, continued
from service.inference.cancellation import Cancellation
from service.inference.copies import MAY_BE_SHARPER_PX, Read, blend
from service.inference.depth_map import NO_ANSWER, DepthMap, Reading, decide, fraction, layers_at
from service.inference.known import Clues, KnownDepth, around
from service.inference.later import Later
from service.inference.pair import SIDE_RANGES, GraphPair, Side, Sights, Stopwatch
from service.inference.part import Part
from service.inference.resampling import Ratio
from service.inference.surroundings import settle
from service.inference.tiles import PIXEL_BUDGET, read_in_tiles
from service.opencv import cv2
from service.optics.camera import Camera

# by a k_cam of 20 px, RMSE on the copies where it is 8, 11 and 14: indoor frames 0.347, 0.289, 0.250 m, table tops
# 0.251, 0.161, 0.164 m; read at full size, by a k_cam of 10.7 px, pooled 0.157 m for 0.155 where it is 8
WELL_READ_K_CAM_PX = 12.0
# of a picture larger than this the network sees too little at a time, and reads it as well where k_cam is this:
WIDE_PX, FINE_K_CAM_PX = 640, 5.0
LEAST_PX = 96  # the longer side of any such copy: of a smaller one nothing is left
# what is as blurred as this part of the most that the model was trained on is read better on a copy of half the size,
# where it is half as blurred and more of its surroundings is seen, and so on: table tops by k_cam 2.64 to 10.7 px
# 0.105, 0.112, 0.103, 0.122 m, where it is 0.2 0.109, 0.116, 0.100, 0.127, indoor frames alike (docs/findings.md)
STRONG_BLUR = 0.17
SMALLER_COPIES = 2
STRONG_FRACTION = 1e-3  # of the picture: a few cells' noise is not worth the time, and in them alone a part may differ
COARSER = 0.5
# how much around a part is read with it, in pixels of each copy: smaller ones see two and four times as far. Of
# parts of 400x300 of refocused frames and table tops of 1920x1440 (k_cam 9 px) one pixel in 12 and one in 43 are off
# by 1.5 % or more from the whole's answer, the farthest by 5 and 6 %; with 320 px of the first for all copies, one in
# 9 and 4, 6 and 14 %
SURROUNDINGS_PX = 320
PLACES, PLACE_PX = 5, 160  # each way: of a photograph of which a part is read, and of a copy
BLURRED_FRACTION = 0.02
FEW_ANSWERS = 0.5
SMALL_PX = 600_000
KEPT_S = 10.0
WARM_UP_PX = 64
# of a lens cap, or an exposure gone wrong: grey levels of all of it, and by how many they differ, noise averaged
BLACK, WHITE, BLANK_SPREAD = 8.0, 250.0, 1.0
NOISE_PX = 8


@dataclass(frozen=True, slots=True)
class _Request:
    """What all copies and tiles are read of: an upright photograph, or a part of it, by the camera behind the whole."""

    rgb: NDArray[np.uint8]
    camera: Camera
    side: Side = "auto"
    cancellation: Cancellation = field(default_factory=Cancellation)
    part: Part | None = None
    stopwatch: Stopwatch = field(default_factory=Stopwatch)
    sights: Sights | None = None  # of small copies, where they are read for more than one camera
    border: Mask | None = None
    warnings: tuple[str, ...] = ()

    def without(self, hidden: Mask | None, name: str) -> Self:
        """The same of what is seen, continued into what shows nothing."""
        if hidden is None:
            return self
        said = f"{name}, {fraction(hidden):.0%} of the photograph, shows nothing: no answer there"
        border = hidden if self.border is None else self.border | hidden
        return replace(self, rgb=continued(self.rgb, hidden), border=border, warnings=(*self.warnings, said))

    def area(self, scale: float, multiple: int) -> Part:
        """What a copy of this scale shows: the photograph, or the part and what the copy needs around it.

        It starts where a copy of the whole has the first pixel of so many, so that both have the same cells.
        """
        height, width = self.rgb.shape[:2]
        part = self.part or Part(0, 0, width, height)
        return part.widened(round(SURROUNDINGS_PX / scale), round(multiple / scale), width, height)


class Estimator:
    """Made once from a model folder; ``estimate`` may be called from several threads at once."""

    def __init__(self, pair: GraphPair, pixel_budget: int = PIXEL_BUDGET) -> None:
        self._pair = pair
        self._pixel_budget = pixel_budget
        self._freeing = Later(pair.free_memory, KEPT_S)
        self._stop_freeing = weakref.finalize(self, self._freeing.stop)

    @classmethod
    def from_folder(cls, folder: ModelFolder, *, intra_op_threads: int = 1) -> Self:
        """Load its graphs; raises ``ModelFolderError`` where they are not what the manifest says."""
        return cls(GraphPair(folder, intra_op_threads))

    @property
    def manifest(self) -> Manifest:
        return self._pair.manifest

    @property
    def _strong_px(self) -> float:
        return STRONG_BLUR * self.manifest.ranges.blur_px.high

    def warm_up(self) -> None:
        """Answer one small grey picture, so that the first request does not pay for preparing the graphs."""
        grey = np.full((WARM_UP_PX, WARM_UP_PX, 3), 128, np.uint8)
        middle = float(np.mean(self.manifest.ranges.focus_distance_m))
        self.estimate(grey, Camera(WARM_UP_PX, WARM_UP_PX, middle, self.manifest.ranges.k_cam_px.high))

    def close(self) -> None:
        """Nothing happens later any more: so too when the process ends."""
        self._stop_freeing()

    def estimate(
        self,
        rgb: NDArray[np.uint8],
        camera: Camera,
        side: Side = "auto",
        cancellation: Cancellation | None = None,
        part: Part | None = None,
        known: Sequence[KnownDepth] = (),
        hidden: Mask | None = None,
    ) -> DepthMap:
        """Depth of an upright photograph, uint8 [h, w, 3] sRGB, whose camera is at exactly that size.

        Of a ``part`` alone it costs what the part and its surroundings cost. Where depths are ``known``, of pixels
        within the photograph, it is first read from one to the other: the answer is then by the camera focused where
        they say, and theirs where they are. Of a photograph that is sharper than the camera's gamma allows, gamma is
        what it shows; the answer's ``camera`` has it. Where it is ``hidden``, bool [h, w], and in a black border there
        is no answer. Raises ``ValueError`` for a camera of another size and ``Cancelled`` when asked to stop.
        """
        height, width = rgb.shape[:2]
        if (width, height) != (camera.image_width_px, camera.image_height_px):
            raise ValueError(f"the camera must be that of a {width}x{height} image: resize it first")
        request = _Request(rgb, camera, side, cancellation or Cancellation(), part)
        request = request.without(hidden, "what is transparent")
        request = request.without(black_border(request.rgb), "a black border")
        request, clues = self._heard(request, known)
        request, read = self._read_sharp(request)
        area, size = read.area, (read.area.height_px, read.area.width_px)
        reading, told = self._reading(request, read, clues)
        if area.height_px * area.width_px > SMALL_PX:
            self._freeing.ask()  # what a large picture has taken is kept for the next one, but for a while only
        request.cancellation.check()
        with request.stopwatch.stage("encode"):
            depth_m, valid = decide(reading, size)
        answer = DepthMap(
            depth_m=depth_m,
            valid=valid,
            layers_at=partial(layers_at, reading, area.width_px),
            camera=area.behind(request.camera),
            scales=read.scales,
            warnings=(),
            timings_ms=request.stopwatch.elapsed_ms,
        )
        blur_px = reading.blur_px
        if part is not None:
            within = part.within(area)
            answer, blur_px = answer.cut(within), within.cells_of(blur_px, size)
        blurrier = fraction(blur_px > read.most_blur_px / reading.scale)
        said = (*request.warnings, *told, *self._warnings(reading, whole=part is None))
        return replace(answer, warnings=(*said, *_hardness(blurrier, answer.valid_fraction)))

    def read(self, rgb: NDArray[np.uint8], camera: Camera, side: Side = "auto") -> Read:
        """What the networks answer, before it is decided what that means: for measuring them."""
        return self._read_copies(_Request(rgb, camera, side))

    def _heard(self, request: _Request, known: Sequence[KnownDepth]) -> tuple[_Request, Clues | None]:
        """The request by the camera that known depths tell, and what else they do, of all that a small copy shows.

        Of a large one they are read with what is around them alone.
        """
        if not known:
            return request, None
        request = replace(request, part=request.part and around(known, request.part), sights=Sights())
        scale = max(self._base_scale(request.camera), _finest_scale(request.camera))
        is_small = scale**2 * request.rgb.shape[0] * request.rgb.shape[1] <= SMALL_PX
        part = request.part if is_small else around(known)
        heard, read = self._read_sharp(replace(request, side="auto", part=part))
        with request.stopwatch.stage("correct"):
            clues = Clues.of(read, heard.camera, request.side, known)
        return replace(request, camera=clues.camera, warnings=heard.warnings), clues

    def _read_sharp(self, request: _Request) -> tuple[_Request, Read]:
        """What the copies show, and the request by a camera that can have taken what is sharp in them."""
        read = self._read_copies(request)
        gamma_px = read.sharper_gamma_px(self._blur_all_over(request, read))
        if gamma_px is None or _is_blank(request.rgb):
            return request, read
        camera, told_px = replace(request.camera, gamma_px=gamma_px), request.camera.gamma_px
        said = f"gamma_px taken as {gamma_px:.3g}, where {told_px:.3g} was told: the photograph is sharper than that"
        request = replace(request, camera=camera, warnings=(*request.warnings, said))
        return request, self._read_copies(request)

    def _blur_all_over(self, request: _Request, read: Read) -> NDArray[np.float32]:
        """What the copy shows; where it is of a part, and the camera may be too soft, what places of the whole do."""
        if request.part is None or read.camera.gamma_px <= MAY_BE_SHARPER_PX:
            return read.maps["blur_px"]
        height, width = request.rgb.shape[:2]
        side = min(height, width, round(PLACE_PX / read.scales[0]))
        size = (max(1, round(side * read.scales[0])),) * 2
        copies = (
            cv2.resize(Part(left, top, left + side, top + side).of(request.rgb), size, interpolation=cv2.INTER_AREA)
            for top in np.linspace(0, height - side, PLACES, dtype=int)
            for left in np.linspace(0, width - side, PLACES, dtype=int)
        )
        seen = [self._pair.see(np.asarray(copy, np.uint8), request.cancellation)["blur_px"] for copy in copies]
        return np.concatenate(seen)

    def _reading(self, request: _Request, read: Read, clues: Clues | None) -> tuple[Reading, tuple[str, ...]]:
        """What the networks' maps, which are written over, and known depths say together, and what to know of those."""
        size = (read.area.height_px, read.area.width_px)
        (low, high), (nearest, farthest) = SIDE_RANGES[request.side], self.manifest.ranges.depth_ratio
        limits_m = max(low, nearest) * read.camera.focus_distance_m, min(high, farthest) * read.camera.focus_distance_m

        with request.stopwatch.stage("correct"):
            if clues is None:
                read = read.softened()
            if request.side == "auto":
                read.doubt_in_focus()

        def reading() -> Reading:
            answer = Reading.of(read.maps, read.camera, size, self.manifest, request.side, read.most_blur_px)
            settle(answer, limits_m, read.stride, max(request.rgb.shape[:2]) * read.scales[0])
            if request.border is not None:
                answer.leave_out(read.area.of(request.border))
            return answer.at_focus(request.camera.focus_distance_m, farthest * request.camera.focus_distance_m)

        if _is_blank(request.rgb):
            told = reading()
            told.error.fill(NO_ANSWER)
            return told, ("the photograph is black or white all over: nothing is seen in it",)
        with request.stopwatch.stage("correct"):
            if clues is None:
                return reading(), ()
            likeness = clues.likeness(read)
            if request.side == "auto":
                clues.lean(read, likeness)
            told = reading()
            unmet = clues.anchor(told, read, likeness)
        return told, (*clues.warnings, *unmet)

    def _told(self, camera: Camera) -> Camera:
        """The camera as the networks are told of it: for one focused farther than they know, one that blurs alike."""
        farthest_m = max(self.manifest.ranges.focus_distance_m.high, 2 * (camera.focal_length_m or 0.0))
        return camera.blurring_alike(farthest_m) if camera.focus_distance_m > farthest_m else camera

    def _base_scale(self, camera: Camera) -> float:
        """The largest copy whose k_cam the model reads well, or a smaller one of a large picture; never enlarged."""
        camera = self._told(camera)
        at_most = min(WELL_READ_K_CAM_PX, self.manifest.ranges.k_cam_px.high) / camera.k_cam_px
        least = LEAST_PX / max(camera.image_width_px, camera.image_height_px)
        return min(1.0, max(at_most, least), max(_finest_scale(camera), FINE_K_CAM_PX / camera.k_cam_px))

    def _read_copies(self, request: _Request) -> Read:
        """What copies of the photograph show: the one that suits its camera, smaller ones, larger ones.

        Strong blur is read on smaller ones. What is so near focus that a large k_cam hardly blurs it, as a macro lens'
        relief, is read on larger ones, each twice the size of the one before: where that shows little blur.
        """
        scale, finest = self._base_scale(request.camera), _finest_scale(request.camera)
        read = self._read_coarsely(request, scale)
        for larger in _doubling(scale, finest):
            if fraction(read.maps["blur_px"] * (larger / scale) < self._strong_px / COARSER) <= STRONG_FRACTION:
                break
            read = self._blended(request, self._read_copy(request, larger), read, by_coarse=True)
            scale = larger
        return read

    def _read_coarsely(self, request: _Request, scale: float, smaller: int = SMALLER_COPIES) -> Read:
        """What a copy of that scale shows, and for strong blur up to so many smaller ones."""
        read = self._read_copy(request, scale)
        is_read_better = smaller > 0 and read.camera.k_cam_px * COARSER >= self.manifest.ranges.k_cam_px.low
        if not is_read_better or fraction(read.maps["blur_px"] > self._strong_px) <= STRONG_FRACTION:
            return read
        return self._blended(request, read, self._read_coarsely(request, scale * COARSER, smaller - 1))

    def _blended(self, request: _Request, read: Read, told: Read, *, by_coarse: bool = False) -> Read:
        """What a copy shows, whose maps are written over, and where blur is strong what a smaller one does."""
        with request.stopwatch.stage("correct"):
            ratio = Ratio(*(small / large for small, large in zip(told.ratio, read.ratio, strict=True)))
            blend(read.maps, told.maps_from(read.area), ratio, self._strong_px, by_coarse=by_coarse)
        most_blur_px = told.most_blur_px * read.scales[0] / told.scales[0]
        return replace(read, scales=read.scales + told.scales, most_blur_px=most_blur_px)

    def _read_copy(self, request: _Request, scale: float) -> Read:
        """What a copy of that scale shows; the layout is seen where all of it is not too wide."""
        area = request.area(scale, self.manifest.multiple)
        working = _copied(area.behind(self._told(request.camera)), scale)
        rgb, size = area.of(request.rgb), (working.image_width_px, working.image_height_px)
        copy = rgb if size == rgb.shape[1::-1] else cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        whole_px = max(request.rgb.shape[:2]) * scale
        is_wide = whole_px > WIDE_PX
        side, cancellation, stopwatch = request.side, request.cancellation, request.stopwatch
        sights = request.sights if size[0] * size[1] <= SMALL_PX else None
        maps = read_in_tiles(
            np.asarray(copy, np.uint8),
            lambda tile: self._pair.read(tile, working, side, cancellation, stopwatch, is_tile=is_wide, sights=sights),
            multiple=self.manifest.multiple,
            stride=self.manifest.stride,
            pixel_budget=self._pixel_budget,
        )
        if is_wide:
            self._pair.lay_out(maps, WIDE_PX / whole_px, cancellation, stopwatch)
        scales = (working.image_width_px / area.width_px,)
        return Read(maps, working, area, self.manifest.stride, scales, self.manifest.ranges.blur_px.high)

    def _warnings(self, reading: Reading, *, whole: bool) -> list[str]:
        camera, scale, ranges = reading.camera, reading.scale, self.manifest.ranges
        size = f" ({camera.image_width_px}x{camera.image_height_px})" if whole else ""
        told = [] if scale == 1 else [f"read at {scale:.3g} of full size{size}"]
        # however large k_cam is, there is a copy that suits it, and that of one is never sharper than its pixels
        k_cam_px = min(camera.k_cam_px, ranges.k_cam_px.high)
        gamma_px = camera.gamma_px if scale == 1 else max(camera.gamma_px, ranges.gamma_px.low)
        told += _outside("k_cam_px at that size", k_cam_px, ranges.k_cam_px)
        told += _outside("gamma_px at that size", gamma_px, ranges.gamma_px)
        told += _outside("focus_distance_m", camera.focus_distance_m, ranges.focus_distance_m)
        return told


def _finest_scale(camera: Camera) -> float:
    """The largest copy of which the network sees enough at a time; never enlarged."""
    return min(1.0, WIDE_PX / max(camera.image_width_px, camera.image_height_px))


def _doubling(scale: float, finest: float) -> list[float]:
    """The scales above one, up to the finest, each twice the one before."""
    return [finest * COARSER**step for step in reversed(range(math.ceil(math.log2(finest / scale))))]


def _copied(camera: Camera, scale: float) -> Camera:
    """The camera behind a copy of its pictures made so much smaller."""
    return camera.averaged(*(max(1, round(size * scale)) for size in (camera.image_width_px, camera.image_height_px)))


def _is_blank(rgb: NDArray[np.uint8]) -> bool:
    """Whether a photograph is black or white all over but for its noise."""
    some = rgb[::NOISE_PX, ::NOISE_PX].mean()
    if BLACK <= some <= WHITE:
        return False
    size = tuple(max(1, pixels // NOISE_PX) for pixels in rgb.shape[1::-1])
    mean, spread = cv2.meanStdDev(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
    return bool((mean.max() < BLACK or mean.min() > WHITE) and spread.max() < BLANK_SPREAD)


def _outside(name: str, value: float, trained: Interval) -> list[str]:
    # a copy's size is a whole number of pixels, so its constants may miss the range by a rounding
    if trained.low * 0.99 <= value <= trained.high * 1.01:
        return []
    return [f"{name} is {value:.4g}, outside {trained.low:g} to {trained.high:g} that the model was trained on"]


def _hardness(blurrier: float, answered: float) -> Iterator[str]:
    if blurrier > BLURRED_FRACTION:
        yield f"{blurrier:.0%} of the pixels show more blur than the model was trained on"
    if answered < FEW_ANSWERS:
        yield f"only {answered:.0%} of the pixels have an answer"
