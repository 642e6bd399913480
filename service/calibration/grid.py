"""Find the printed grid in a photograph, sharp or blurred, and say which circle is which.

Both kinds of grid are a square lattice. Dark blobs are joined to a lattice neighbour by neighbour, so that perspective
and distortion only need to be small from one circle to the next, and the lattice is then laid over the printed
pattern in every rotation.
"""

import math
from collections.abc import Callable, Iterator
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from service.calibration.numerics import cKDTree
from service.calibration.target import CircleGrid, Kind
from service.opencv import cv2

COARSEST_PX = 640
FINEST_PX = 2600
LEAST_AREA_PX = 16.0
LEAST_APART_PX = 4.0
LARGEST_PART = 0.3
# below, a circle of the largest part has less than the least area
LEAST_SIDE_PX = math.ceil(math.sqrt(LEAST_AREA_PX) / LARGEST_PART)
THRESHOLDS = np.arange(8.0, 248.0, 8.0)
LEAST_THRESHOLDS = 2  # that a blob is seen at
LEAST_CIRCULARITY = 0.6
LEAST_CONVEXITY = 0.85
LEAST_INERTIA = 0.15
NEIGHBOURS = 8
NESTED = 3  # blobs in one place, of which one may be a circle and another the outline of the sheet about it
SEEDS = 40
LEAST_PLACED = 4  # circles, from which what is hidden can be filled in
MOST_TRIES = 16  # at laying a lattice, each from another seed or along other axes
MOST_GROWN = 4  # times the circles wanted: a lattice that goes on is not the pattern
ANGLES_DEG = (35.0, 145.0)
LIKE_LENGTH = 2.2
LIKE_SIZE = 1.6
REACH = 0.32
LEAST_FOUND = 0.7
BORDER_STEPS = 0.9
LEAST_RADIUS_PX = 3.0
NOTHING = "no grid of dark circles was found"
Array = NDArray[np.float64]
Cell = tuple[int, int]


class GridError(Exception):
    """Why the grid was not found, in words for the user."""


@dataclass(frozen=True, slots=True)
class FoundGrid:
    """Where the printed circles [n, 2] are in the picture (px), row by row, and about how large [n].

    ``seen`` [n] is False where a circle was filled in from its neighbours.
    """

    centres_px: Array
    radii_px: Array
    seen: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _Blobs:
    places: Array
    sizes: Array
    tree: cKDTree


def find_grid(grey: NDArray[np.uint8], grid: CircleGrid, check: Callable[[], None] = lambda: None) -> FoundGrid:
    """The grid in a grey picture [h,w]. Raises ``GridError`` that says what is wrong with the picture.

    Looks at a small copy first, in which blur is small too, and at larger ones for small circles. ``check`` is called
    again and again and may raise to stop the work.
    """
    nearest = GridError(NOTHING)
    longest = max(grey.shape)
    side = min(COARSEST_PX, longest)
    while True:
        ratio = side / longest
        try:
            found = _find(_smaller(grey, ratio), grid, check)
        except GridError as error:
            nearest = max(nearest, error, key=lambda one: len(str(one)))
        else:
            return _checked(found, ratio, grid)
        if side >= min(FINEST_PX, longest):
            raise nearest
        side = min(2 * side, FINEST_PX, longest)


def _smaller(grey: NDArray[np.uint8], ratio: float) -> NDArray[np.uint8]:
    if ratio * min(grey.shape) < LEAST_SIDE_PX:
        raise GridError(NOTHING)
    if ratio == 1:
        return grey
    return np.asarray(cv2.resize(grey, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA), np.uint8)


def _checked(found: FoundGrid, ratio: float, grid: CircleGrid) -> FoundGrid:
    """The grid at the size of the whole picture, if its circles are large enough and all in it."""
    centres = (found.centres_px + 0.5) / ratio - 0.5
    radii = radii_px(grid, centres)
    if float(np.median(radii)) < LEAST_RADIUS_PX:
        raise GridError(
            f"the circles are too small: {2 * np.median(radii):.1f} px across, {2 * LEAST_RADIUS_PX:g} are needed"
        )
    return FoundGrid(centres, radii, found.seen)


def homography(points_mm: Array, centres_px: Array) -> Array:
    """The map [3,3] from millimetres on the sheet to pixels that fits all circles [n,2] best."""
    matrix, _ = cv2.findHomography(points_mm, centres_px, 0)
    return np.asarray(matrix, np.float64)


def projected(matrix: Array, points: Array) -> Array:
    """Points [n,2] through a homography."""
    through = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(through[:, :2] / through[:, 2:])


def radii_px(grid: CircleGrid, centres_px: Array) -> Array:
    """About how large each circle is in the picture: the geometric mean of its semi-axes [n]."""
    points = grid.points_mm()
    matrix = homography(points, centres_px)
    return radii_through(lambda at: projected(matrix, at), points, grid.diameter_mm)


def radii_through(seen: Callable[[Array], Array], points_mm: Array, diameter_mm: float) -> Array:
    """The same of circles about points [n,2] of the sheet, by a map of places [n,2] on it (mm) to pixels [n,2]."""
    right, down = np.eye(2) * diameter_mm / 8
    across, along = (seen(points_mm + step) - seen(points_mm - step) for step in (right, down))
    area = np.abs(across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0])
    return np.asarray(2 * np.sqrt(area))


def _find(grey: NDArray[np.uint8], grid: CircleGrid, check: Callable[[], None]) -> FoundGrid:
    blobs = _blobs(grey, check)
    wanted = _lattice_cells(grid)
    best: dict[Cell, int] = {}
    others: set[int] = set()  # in a lattice that goes on, as the holes of a board under the sheet are
    tries = 0
    for first, u, v in _seeds(blobs, others):
        check()
        cells = _grown(blobs, first, u, v, MOST_GROWN * len(wanted))
        if len(cells) > len(best):
            best = cells
        if len(cells) >= MOST_GROWN * len(wanted):
            others.update(cells.values())
        elif len(cells) >= LEAST_FOUND * len(wanted):
            found = _laid(cells, blobs, wanted, grid)
            tries += 1
            if found is not None:
                return found
            if tries == MOST_TRIES:
                break
    raise GridError(_why(best, blobs, wanted, grid, grey.shape))


def _blobs(grey: NDArray[np.uint8], check: Callable[[], None]) -> _Blobs:
    """What is dark and round at several thresholds: the mean of its places and sizes over them.

    OpenCV's detector finds the blobs of one threshold at a time: over many at once it compares each with each, which
    takes minutes for a picture full of dots, and cannot be stopped.
    """
    last = np.empty((0, 3))
    seen = []
    for threshold in THRESHOLDS:
        check()
        found = _seen_at(float(threshold), grey)
        numbers = _continued(found, last)
        last = np.concatenate([last, found[numbers >= len(last)]])
        last[numbers] = found
        seen.append((numbers, found))
    numbers, found = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    count = np.bincount(numbers)
    often = count >= LEAST_THRESHOLDS
    if often.sum() < 4:
        raise GridError(NOTHING)
    u, v, sizes = (np.bincount(numbers, column)[often] / count[often] for column in found.T)
    places = np.stack([u, v], 1)
    return _Blobs(places, sizes, cKDTree(places))


def _seen_at(threshold: float, grey: NDArray[np.uint8]) -> Array:
    """Place and size [n,3] of what is dark and round at one threshold."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.minThreshold, settings.maxThreshold, settings.thresholdStep = threshold, threshold + 1, 2.0
    settings.minRepeatability = 1
    settings.filterByColor, settings.blobColor = True, 0
    settings.filterByArea = True
    settings.minArea, settings.maxArea = LEAST_AREA_PX, (LARGEST_PART * min(grey.shape)) ** 2
    settings.filterByCircularity, settings.minCircularity = True, LEAST_CIRCULARITY
    settings.filterByConvexity, settings.minConvexity = True, LEAST_CONVEXITY
    settings.filterByInertia, settings.minInertiaRatio = True, LEAST_INERTIA
    found = cv2.SimpleBlobDetector.create(settings).detect(grey)
    return np.array([(*blob.pt, blob.size) for blob in found], np.float64).reshape(-1, 3)


def _continued(found: Array, last: Array) -> NDArray[np.intp]:
    """The number of each blob [n,3]: the one it had in ``last`` where it goes on, else the next one that is free.

    One of another size is another one: the sheet's outline about the circle in its middle.
    """
    numbers = np.full(len(found), -1, np.intp)
    if len(last) and len(found):
        away, near = _nearest(cKDTree(last[:, :2]), found[:, :2])
        size, before = found[:, 2, None], last[near, 2]
        goes_on = away < np.maximum(np.maximum(size, before) / 2, LEAST_APART_PX)
        goes_on &= _is_alike(size / before)
        numbers = np.where(goes_on.any(1), near[np.arange(len(near)), goes_on.argmax(1)], numbers)
    is_new = numbers < 0
    numbers[is_new] = len(last) + np.arange(is_new.sum())
    return numbers


def _nearest(tree: cKDTree, places: Array) -> tuple[Array, NDArray[np.intp]]:
    """How far the few blobs nearest to a place [..., 2] are, and which, the nearest first [..., few]."""
    away, near = tree.query(places, np.arange(1, min(NESTED, tree.n) + 1))
    return np.asarray(away, np.float64), np.asarray(near, np.intp)


def _is_alike(ratio: Array) -> NDArray[np.bool_]:
    """Whether sizes of which these are the ratios may be those of one circle, or of two that are neighbours."""
    return (ratio < LIKE_SIZE) & (ratio > 1 / LIKE_SIZE)


def _seeds(blobs: _Blobs, others: AbstractSet[int]) -> Iterator[tuple[int, Array, Array]]:
    """Blobs with two neighbours that may be those along the lattice's two axes, most regular surroundings first.

    None of the ``others``, which may become more meanwhile.
    """
    count = min(NEIGHBOURS + 1, len(blobs.places))
    away, beside = (np.asarray(found) for found in blobs.tree.query(blobs.places, count))
    evenness = away[:, min(4, count - 1)] / np.maximum(away[:, 1], 1e-6)
    alike = np.ptp(np.log(blobs.sizes[beside[:, : min(5, count)]]), axis=1)
    for first in islice((blob for blob in np.argsort(evenness + 2 * alike).tolist() if blob not in others), SEEDS):
        steps = blobs.places[beside[first, 1:]] - blobs.places[first]
        sizes = blobs.sizes[beside[first, 1:]] / blobs.sizes[first]
        steps = steps[_is_alike(sizes)]
        for i in range(min(4, len(steps))):
            for j in range(i + 1, min(5, len(steps))):
                u, v = steps[i], steps[j]
                angle = math.degrees(math.acos(np.clip(u @ v / np.linalg.norm(u) / np.linalg.norm(v), -1, 1)))
                lengths = np.linalg.norm(u) / np.linalg.norm(v)
                is_likely = ANGLES_DEG[0] < angle < ANGLES_DEG[1] and 1 / LIKE_LENGTH < lengths < LIKE_LENGTH
                if is_likely and first not in others:
                    yield first, u, v


def _grown(blobs: _Blobs, first: int, u: Array, v: Array, most: int) -> dict[Cell, int]:
    """The lattice that goes on from one blob, to about ``most`` cells: cell to blob. Each step is guessed from the
    steps next to it.
    """
    cells: dict[Cell, int] = {(0, 0): first}
    taken = {first}
    bases = {(0, 0): (u, v)}
    edge = [(0, 0)]
    while edge and len(cells) < most:
        cell = edge.pop(0)
        here, basis = blobs.places[cells[cell]], bases[cell]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            beside = (cell[0] + sign * (axis == 0), cell[1] + sign * (axis == 1))
            if beside in cells:
                continue
            step = sign * basis[axis]
            away, near = _nearest(blobs.tree, here + step)
            is_next = (away < REACH * np.linalg.norm(step)) & _is_alike(blobs.sizes[near] / blobs.sizes[cells[cell]])
            found = next((int(blob) for blob in near[is_next] if int(blob) not in taken), None)
            if found is None:
                continue
            cells[beside] = found
            taken.add(found)
            bases[beside] = _basis(cells, blobs, beside, basis)
            edge.append(beside)
    return cells


def _basis(cells: dict[Cell, int], blobs: _Blobs, cell: Cell, basis: tuple[Array, Array]) -> tuple[Array, Array]:
    """The lattice's two steps at a cell: measured to neighbours that are known, else those of where one came from."""
    here = blobs.places[cells[cell]]
    steps = []
    for axis in (0, 1):
        known = [
            sign * (blobs.places[cells[beside]] - here)
            for sign in (1, -1)
            if (beside := (cell[0] + sign * (axis == 0), cell[1] + sign * (axis == 1))) in cells
        ]
        steps.append(np.mean(known, axis=0) if known else basis[axis])
    return steps[0], steps[1]


def _lattice_cells(grid: CircleGrid) -> list[Cell]:
    """The printed circles' places in the lattice of nearest neighbours, row by row."""
    points = np.rint(grid.points_mm() / grid.spacing_mm).astype(int)
    if grid.kind == "asymmetric_circles":
        points = np.stack([(points[:, 0] + points[:, 1]) // 2, (points[:, 1] - points[:, 0]) // 2], 1)
    return [(int(a), int(b)) for a, b in points]


def _laid(cells: dict[Cell, int], blobs: _Blobs, wanted: list[Cell], grid: CircleGrid) -> FoundGrid | None:
    """The lattice laid over the printed pattern where most circles meet, seen from the front; None if it cannot be."""
    spare = max(2, 0.05 * len(wanted))
    if len(cells) - len(wanted) > spare:
        return None
    ways = [(turn, shift, hits) for turn in range(4) for shift, hits in _shifts(cells, wanted, turn)]
    if not ways:
        return None
    most = max(hits for _, _, hits in ways)
    if most < max(LEAST_FOUND * len(wanted), LEAST_PLACED) or len(cells) - most > spare:
        return None
    options = []
    covered = set()
    for turn, shift, hits in ways:
        if hits == most:
            moved = [_moved(cell, turn, shift) for cell in wanted]
            covered.add(frozenset(moved))
            chosen = [cells.get(cell) for cell in moved]
            seen = np.array([blob is not None for blob in chosen])
            places = np.array([blobs.places[blob] if blob is not None else (np.nan, np.nan) for blob in chosen])
            options.append((places, seen))
    if most < len(wanted) and len(covered) > 1:
        return None  # what is missing may be so on either side
    fronts = [option for option in options if _is_from_front(grid, *option)]
    if not fronts:
        return None
    places, seen = min(fronts, key=lambda option: _turn_to_upright(grid, *option))
    if not _shows_all_sides(seen.reshape(grid.rows, grid.columns)):
        return None
    if not seen.all():
        points = grid.points_mm()
        places[~seen] = projected(homography(points[seen], places[seen]), points[~seen])
    return FoundGrid(places, np.zeros(len(places)), seen)


def _shows_all_sides(seen: NDArray[np.bool_]) -> bool:
    """Whether all four outer rows and columns are there [rows, columns]: else the sheet may have fewer.

    A single circle of one is not enough, for it may be something that lies beside the sheet.
    """
    return all(side.sum() >= min(2, side.size - 1) for side in (seen[0], seen[-1], seen[:, 0], seen[:, -1]))


def _moved(cell: Cell, turn: int, shift: Cell) -> Cell:
    a, b = cell
    for _ in range(turn):
        a, b = -b, a
    return a + shift[0], b + shift[1]


def _shifts(cells: dict[Cell, int], wanted: list[Cell], turn: int) -> Iterator[tuple[Cell, int]]:
    """Every shift that may lay the turned pattern on the lattice, with how many circles then meet."""
    turned = np.array([_moved(cell, turn, (0, 0)) for cell in wanted])
    have = np.array(list(cells))
    low, high = have.min(0) - turned.max(0), have.max(0) - turned.min(0)
    corner = np.minimum(turned.min(0) + low, have.min(0))
    occupied = np.zeros(np.maximum(turned.max(0) + high, have.max(0)) - corner + 1, bool)
    occupied[tuple((have - corner).T)] = True
    for a in range(low[0], high[0] + 1):
        for b in range(low[1], high[1] + 1):
            at = turned + np.array([a, b]) - corner
            hits = int(occupied[at[:, 0], at[:, 1]].sum())
            if hits >= LEAST_FOUND * len(wanted):
                yield (a, b), hits


def _axes(grid: CircleGrid, places: Array, seen: NDArray[np.bool_]) -> Array:
    """The sheet's x and y directions in the picture, as columns [2,2]."""
    points = grid.points_mm()[seen]
    design = np.column_stack([points, np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(design, places[seen], rcond=None)[0][:2].T)


def _is_from_front(grid: CircleGrid, places: Array, seen: NDArray[np.bool_]) -> bool:
    return float(np.linalg.det(_axes(grid, places, seen))) > 0


def _turn_to_upright(grid: CircleGrid, places: Array, seen: NDArray[np.bool_]) -> float:
    """How far (rad) the sheet's x axis is from pointing right."""
    right = _axes(grid, places, seen)[:, 0]
    return abs(math.atan2(right[1], right[0]))


def _why(cells: dict[Cell, int], blobs: _Blobs, wanted: list[Cell], grid: CircleGrid, shape: tuple[int, ...]) -> str:
    """What the largest lattice that was seen has of the pattern, in words."""
    if len(cells) < max(6, 0.3 * len(wanted)):
        return NOTHING
    places = blobs.places[list(cells.values())]
    step = float(np.median(np.asarray(blobs.tree.query(places, 2)[0])[:, 1]))
    low, high = places.min(0), places.max(0)
    margin = np.concatenate([low, np.array(shape[1::-1]) - 1 - high])
    if len(cells) < len(wanted) and margin.min() < BORDER_STEPS * step:
        return (
            f"only {len(cells)} of the grid's {len(wanted)} circles are in the picture: it is cropped, or has other "
            "rows and columns"
        )
    if len(cells) < len(wanted):
        return (
            f"only {len(cells)} of the grid's {len(wanted)} circles were seen; the rest is hidden or too faint, or the "
            f"sheet has other rows and columns{_likeness(cells, blobs, grid)}"
        )
    if len(cells) >= MOST_GROWN * len(wanted):
        seen = f"at least {len(cells)} circles was seen that is not the pattern given ({len(wanted)} circles)"
    else:
        likeness = _likeness(cells, blobs, grid)
        seen = f"{len(cells)} circles was seen that is not the pattern given ({len(wanted)} circles){likeness}"
    return (
        f"a grid of {seen}: check kind, rows and columns, that the picture is not mirrored, and that no dots or holes "
        "are about the sheet"
    )


def _likeness(cells: dict[Cell, int], blobs: _Blobs, grid: CircleGrid) -> str:
    """Which pattern the lattice looks like instead, the one most like what is seen and given, to be said after it."""
    a, b = np.array(list(cells)).T
    across, along, rising, falling = (_extent(places) for places in (a, b, a + b, a - b))
    sizes: list[tuple[Kind, int, int]] = [
        ("symmetric_circles", across, along),
        ("symmetric_circles", along, across),
        ("asymmetric_circles", rising, falling // 2),
        ("asymmetric_circles", falling, rising // 2),
    ]
    given = (grid.kind, grid.rows, grid.columns)
    sizes = [size for size in sizes if size != given and min(size[1:]) >= 2]
    over = {(b, a): blob for (a, b), blob in cells.items()}  # axes may be named either way round, and are only turned
    for kind, rows, columns in sorted(sizes, key=lambda size: _unlikeness(size, given, len(cells))):
        other = CircleGrid(kind, rows, columns, 2.0, 1.0)
        if any(_laid(lattice, blobs, _lattice_cells(other), other) for lattice in (cells, over)):
            return f"; it looks like {rows} rows, {columns} columns" + f" of {kind}" * (kind != grid.kind)
    return ""


def _extent(places: NDArray[np.int64]) -> int:
    """How many lines of a lattice there are from the first to the last, those with a single circle not counted."""
    lines, count = np.unique(places, return_counts=True)
    return int(np.ptp(lines[count > 1])) + 1 if (count > 1).any() else 0


def _unlikeness(size: tuple[Kind, int, int], given: tuple[Kind, int, int], circles: int) -> tuple[int, bool, int]:
    missing = abs(size[1] * size[2] - circles)
    return missing, size[0] != given[0], abs(size[1] - given[1]) + abs(size[2] - given[2])
