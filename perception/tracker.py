"""Markers followed through images: where each is, how far it moved from the first image, and whether it is seen.

In every image all dots are found anew, so nothing drifts; then each is given to the marker that it belongs to. That
starts from where the markers were one image ago, trusts those that hardly moved, and spreads over the grid from
these, each marker expected where its neighbours went. When most are lost the grid is grown from nothing again.
No random numbers, no clock: the same images in the same order give the same numbers.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gelflow.errors import PeerError, UsageError
from gelflow.perception.detect import Dots, contrast, find_dots
from gelflow.perception.grid import Found, Polarity, find_grid, surroundings
from gelflow.perception.lattice import fill, grow, neighbours
from gelflow.perception.refusal import StartRefused

__all__ = ["MarkerTracker", "StartRefused", "Tracked", "TrackerConfig"]

# All as shares of the markers' spacing.
_SURE = 0.25  # a dot this close to where a marker was is that marker's
_NEAR = 0.3  # a dot this close to where a marker is expected from its neighbours is that marker's
_TORN = 0.5  # a marker whose displacement is this far from its neighbours' mean is somebody else's dot
_APART = 0.4  # dots nearer to each other than this are seen as one
_VOTE = 0.1  # width of the bins in which markers vote for a common shift

_AREA = (0.45, 1.65)  # a dot's area against its reference (and against how all areas changed): else cut or merged
_FAINT = 0.3  # of the usual contrast: weaker spots are no dots


@dataclass(frozen=True)
class TrackerConfig:
    """What is known of the markers before the first image."""

    rows: int | None = None  # lines of markers in the image; None: found
    cols: int | None = None  # markers in a line; None: found
    either_way: bool = True  # rows and cols may also be the other way round in the image
    polarity: Polarity = "auto"  # dots darker or brighter than the gel


@dataclass(frozen=True)
class Tracked:
    """The markers in one image, line by line from the top, each line from the left."""

    position: NDArray[np.float64]  # (right, down) [px], shape (markers, 2); where not valid, where it is expected
    displacement: NDArray[np.float64]  # from rest [px], shape (markers, 2); NaN where neither valid nor inferred
    valid: NDArray[np.bool_]  # measured in this image, shape (markers,)
    inferred: NDArray[np.bool_]  # not measured, guessed from its neighbours, shape (markers,)
    quality: NDArray[np.float64]  # 0 to 1: how far the measurement can be believed; 0 where not valid, (markers,)
    rows: int  # lines in the image
    cols: int  # markers in a line
    spacing: float  # of the markers in the first image [px]


class MarkerTracker:
    """Follows the markers of one camera. The first image is the reference of all displacements."""

    def __init__(self, config: TrackerConfig | None = None) -> None:
        self.config = TrackerConfig() if config is None else config
        self._found: Found | None = None
        self._size = (0, 0)
        self._last: NDArray[np.float64] = np.zeros((0, 0, 2))
        self._seen_before = 0
        self._images_lost = 0

    @property
    def rest(self) -> NDArray[np.float64]:
        """Where the markers are at rest (right, down) [px], shape (markers, 2), line by line.

        Raises UsageError before `start`.
        """
        if self._found is None:
            raise UsageError("the tracker has no rest positions yet: start it with an image at rest")
        return self._found.positions.reshape(-1, 2)

    def start(self, image: NDArray[np.uint8], rows: int | None = None, cols: int | None = None) -> Tracked:
        """Finds the grid in `image` (B G R) and takes it as the reference; displacements in it are zero.

        `rows` and `cols` are lines and markers in a line; left out, the configuration's, and if it has none, found.
        Raises StartRefused when the image shows no such grid, or not clearly.
        """
        c = self.config
        rows, cols = (c.rows, c.cols) if rows is None and cols is None else (rows, cols)
        found = find_grid(image, rows=rows, cols=cols, either_way=c.either_way, polarity=c.polarity)
        self._found, self._size = found, (image.shape[0], image.shape[1])
        self._last = found.positions.copy()
        self._seen_before, self._images_lost = int(found.seen.sum()), 0
        return self._tracked(found, np.zeros_like(self._last), found.seen)

    def track(self, image: NDArray[np.uint8]) -> Tracked:
        """The markers in the next image (B G R). The first call is `start`.

        A marker that is not seen, or not for certain, is not valid. Raises PeerError when the image's size changes.
        """
        found = self._found
        if found is None:
            return self.start(image)
        if image.shape[:2] != self._size:
            got, expected = (f"{width} × {height} px" for height, width in (image.shape[:2], self._size))
            raise PeerError(
                f"the image's size changed from {expected} to {got}: start the tracker anew for another camera"
            )
        response = contrast(image, found.look, surroundings(found.spacing))
        least = _FAINT * found.peak
        dots = find_dots(response, radius=found.radius, apart=_APART * found.spacing, least=least)
        owner = _follow(dots.centers, self._last, found.spacing)
        if self._should_regrow(owner, dots):
            again = _regrow(dots, self._last, found)
            owner = again if (again >= 0).sum() > (owner >= 0).sum() else owner
        displacement, valid = _judge(owner, dots, found)
        self._seen_before = int((owner >= 0).sum())
        if valid.any():
            displacement = fill(displacement, valid)
            self._last = found.positions + displacement
        return self._tracked(found, displacement, valid & found.seen)

    def _should_regrow(self, owner: NDArray[np.intp], dots: Dots) -> bool:
        """Whether growing the grid anew is worth its time: a line's worth of markers vanished, though dots are left."""
        have = int((owner >= 0).sum())
        line = min(owner.shape)
        self._images_lost = self._images_lost + 1 if have < 0.8 * owner.size else 0
        suddenly = self._seen_before - have >= 0.5 * line
        return len(dots) - have >= 0.5 * line and (suddenly or self._images_lost % 10 == 1)

    def _tracked(self, found: Found, displacement: NDArray[np.float64], valid: NDArray[np.bool_]) -> Tracked:
        inferred = ~valid & valid.any()
        shown = np.where((valid | inferred)[..., None], displacement, np.nan).reshape(-1, 2)
        position, rows, cols = self._last.reshape(-1, 2).copy(), *found.shape
        flat = valid.reshape(-1)
        return Tracked(position, shown, flat, inferred.reshape(-1), flat.astype(np.float64), rows, cols, found.spacing)


def _follow(centers: NDArray[np.float64], last: NDArray[np.float64], spacing: float) -> NDArray[np.intp]:
    """For each marker the number of its dot, or −1, shape (lines, columns), from where the markers were."""
    shape = last.shape[:2]
    owner = np.full(shape, -1, dtype=np.intp)
    if len(centers) < 4:
        return owner
    tree = cKDTree(centers)
    expected = last
    sure = _claim(owner, tree, expected, np.ones(shape, dtype=bool), _SURE * spacing)
    if sure < 0.6 * owner.size:
        shift = _common_shift(centers, tree, last, spacing)
        if shift is not None:
            owner[:] = -1
            expected = last + shift
            _claim(owner, tree, expected, np.ones(shape, dtype=bool), _SURE * spacing)
    for _ in range(2):
        known = owner >= 0
        step = centers[owner] - expected
        mean, some = neighbours(step, known)
        owner[known & some & (np.linalg.norm(step - mean, axis=-1) > _NEAR * spacing)] = -1
    for _ in range(sum(shape)):
        known = owner >= 0
        mean, some = neighbours(centers[owner] - expected, known)
        open_ = some & ~known
        if not open_.any() or not _claim(owner, tree, expected + mean, open_, _NEAR * spacing):
            break
    return owner


def _claim(
    owner: NDArray[np.intp], tree: cKDTree, expected: NDArray[np.float64], which: NDArray[np.bool_], within: float
) -> int:
    """Gives dots that are free and near to those markers of `which`; the nearest marker gets a dot. How many."""
    markers = np.flatnonzero(which)
    distance, dot = tree.query(expected.reshape(-1, 2)[markers])
    free = np.ones(tree.n, dtype=bool)
    free[owner[owner >= 0]] = False
    near = (distance < within) & free[dot]
    markers, dot, distance = markers[near], dot[near], distance[near]
    order = np.argsort(distance, kind="stable")
    _, first = np.unique(dot[order], return_index=True)
    chosen = order[first]
    owner.reshape(-1)[markers[chosen]] = dot[chosen]
    return len(chosen)


def _common_shift(
    centers: NDArray[np.float64], tree: cKDTree, last: NDArray[np.float64], spacing: float
) -> NDArray[np.float64] | None:
    """The shift (2,) [px] that most markers agree on, within a spacing; None when fewer than half do."""
    flat = last.reshape(-1, 2)
    distance, dot = tree.query(flat, k=min(4, len(centers)))
    steps = (centers[dot] - flat[:, None])[distance < spacing]
    if len(steps) == 0:
        return None
    half = int(np.ceil(1 / _VOTE))
    cell = np.round(steps / (_VOTE * spacing)).astype(np.intp) + half
    votes = np.zeros((2 * half + 3, 2 * half + 3))
    np.add.at(votes, (cell[:, 0] + 1, cell[:, 1] + 1), 1)
    # A shift near a bin's edge spreads over its neighbours.
    wide = cv2.boxFilter(votes, -1, (3, 3), normalize=False)[1:-1, 1:-1]
    best = np.array(np.unravel_index(int(np.argmax(wide)), (2 * half + 1, 2 * half + 1)))
    if np.max(wide) < 0.5 * len(flat):
        return None
    agree = (np.abs(cell - best) <= 1).all(axis=1)
    return np.asarray(np.median(steps[agree], axis=0))


def _regrow(dots: Dots, last: NDArray[np.float64], found: Found) -> NDArray[np.intp]:
    """For each marker the number of its dot, or −1, from the grid that the dots form by themselves.

    Which line is which follows from the number of whole dots that the grid then has; among placements that are
    nearly as full, the one nearest to where the markers were.
    """
    rows, cols = found.shape
    none = np.full((rows, cols), -1, dtype=np.intp)
    lattice = grow(dots.centers)
    if lattice is None:
        return none
    grid = np.full((lattice.shape[0] + 2 * rows, lattice.shape[1] + 2 * cols), -1, dtype=np.intp)
    grid[rows:-rows, cols:-cols] = lattice.dots
    places = [(i, j) for i in range(1, lattice.shape[0] + rows) for j in range(1, lattice.shape[1] + cols)]
    whole = np.pad(((grid >= 0) & dots.inside[grid]).astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    counts = np.array(
        [whole[i + rows, j + cols] - whole[i, j + cols] - whole[i + rows, j] + whole[i, j] for i, j in places]
    )
    best, best_shift = none, np.inf
    for k in np.flatnonzero(counts >= 0.85 * counts.max()):
        i, j = places[k]
        part = grid[i : i + rows, j : j + cols]
        shift = float(np.median(np.linalg.norm(dots.centers[part] - last, axis=-1)[part >= 0]))
        if shift < best_shift:
            best, best_shift = part, shift
    return best.copy()


def _judge(owner: NDArray[np.intp], dots: Dots, found: Found) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Displacement from the reference [px], shape (lines, columns, 2), and which of them can be believed."""
    if len(dots) == 0:
        return np.zeros((*found.shape, 2)), np.zeros(found.shape, dtype=bool)
    displacement = dots.centers[owner] - found.positions
    growth = dots.areas[owner] / found.areas
    valid = (owner >= 0) & dots.inside[owner]
    usual = float(np.median(growth[valid])) if valid.any() else 1.0
    valid &= (growth > _AREA[0] * usual) & (growth < _AREA[1] * usual)
    mean, some = neighbours(displacement, valid)
    valid &= ~some | (np.linalg.norm(displacement - mean, axis=-1) < _TORN * found.spacing)
    return displacement, valid
