"""The grid of markers in a first image, with nothing known but, perhaps, how many lines and columns it has."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.perception.detect import BRIGHT, DARK, Dots, Look, contrast, find_dots, smaller
from gelflow.perception.errors import TrackerInitError, draw_seen
from gelflow.perception.lattice import Lattice, fill, grow

Polarity = Literal["auto", "dark", "bright"]

_RADII = (2.2, 3.2, 4.6, 6.6, 9.5, 14.0)  # of dots that are looked for [px], in an image of about _SEARCH px
_SEARCH = 360
_MOST = 2500  # dots beyond these, in order of contrast, are texture
_BETWEEN = 0.4  # dots between a grid's lines, for each on them, from which on it is another grid
_UNEVEN = 0.12  # a grid whose nodes are further from the middle of their neighbours (share of spacing) is chance


@dataclass(frozen=True)
class Found:
    """A grid of markers at rest, as the first image shows it. Lines run downwards, columns to the right."""

    look: Look
    radius: float  # of a dot [px]
    spacing: float  # between neighbours [px]
    positions: NDArray[np.float64]  # (right, down) [px], shape (lines, columns, 2); unseen ones are interpolated
    seen: NDArray[np.bool_]  # shape (lines, columns)

    @property
    def shape(self) -> tuple[int, int]:
        return self.seen.shape[0], self.seen.shape[1]

    def scaled(self, factor: float) -> "Found":
        """The same grid in an image made larger by `factor`, or smaller."""
        places = (self.positions + 0.5) * factor - 0.5
        return replace(self, radius=factor * self.radius, spacing=factor * self.spacing, positions=places)


def surroundings(spacing: float) -> int:
    """Side of the box [px] that a dot is compared with: one period, so that a regular grid leaves no ripple."""
    return max(round(spacing), 3) | 1


def find_grid(
    image: NDArray[np.uint8],
    *,
    rows: int | None = None,
    cols: int | None = None,
    either_way: bool = True,
    polarity: Polarity = "auto",
) -> Found:
    """Finds the grid of markers in `image` (B G R).

    With `rows` and `cols` the grid has that many lines and columns (with `either_way`, or the other way round);
    lines beyond, which the image's border cuts, are left out. Without, every line that is mostly there counts.
    Raises TrackerInitError when there is no grid, or one of other rows and columns than asked for; UsageError when no
    grid can have these.
    """
    wanted = _wanted(rows, cols, either_way)
    shrink = max(1, round(max(image.shape[:2]) / _SEARCH))
    small = smaller(image, shrink)
    looks = _looks(small, polarity)
    best = _search(small, looks)
    if best is None:
        raise _nothing(image, looks[0], polarity)
    look, radius, spacing = best
    # Once more, now that radius and spacing are known.
    dots = _likely(find_dots(contrast(small, look, surroundings(spacing)), radius=radius, apart=0.4 * spacing))
    lattice = grow(dots.centers)
    refusal, part = _distrust(lattice, dots, polarity), None
    if lattice is not None and not refusal:
        refusal, part = _window(lattice, dots, rows, cols, wanted)
    if part is None:
        raise TrackerInitError(refusal, draw_seen(small, dots.centers, radius, lattice.dots if lattice else None))
    return _found(look, part, dots).scaled(shrink)


def _looks(image: NDArray[np.uint8], polarity: Polarity) -> tuple[Look, ...]:
    """The looks to try, likely ones first: dots are few pixels, far from the mean on one side."""
    if polarity != "auto":
        return DARK if polarity == "dark" else BRIGHT
    stands_out = contrast(image, BRIGHT[0], round(5 * _RADII[2]))
    return BRIGHT + DARK if float((stands_out**3).mean()) > 0 else DARK + BRIGHT


def _nothing(image: NDArray[np.uint8], look: Look, polarity: Polarity) -> TrackerInitError:
    """The refusal of an image without a grid, by what stands out in it."""
    sizes = [
        (r, find_dots(contrast(image, look, round(5 * r)), radius=r, apart=1.5 * r, least=0.1)) for r in _RADII[::2]
    ]
    radius, dots = max(sizes, key=lambda size: len(size[1]))
    if len(dots) > _MOST:
        seen = f"{len(dots)} spots stand out, and a grid of markers has at most {_MOST}"
    elif len(dots) >= 9:
        seen = f"{len(dots)} spots stand out, but they form no lines and columns"
    else:
        seen = f"{len(dots) or 'no'} dots stand out, and a grid of markers has at least 3 × 3"
    picture = draw_seen(image, dots.centers, radius, None)
    return TrackerInitError(f"no grid of markers found in the image: {seen}{_hint(polarity)}", picture)


def _hint(polarity: Polarity) -> str:
    other = {"dark": " (looked for dark dots only)", "bright": " (looked for bright dots only)", "auto": ""}
    return f"{other[polarity]}; check light, focus and that it shows a gel"


def _wanted(rows: int | None, cols: int | None, either_way: bool) -> list[tuple[int, int]]:
    if rows is None and cols is None:
        return []
    if rows is None or cols is None:
        raise UsageError("give both rows and cols of the grid of markers, or neither")
    if min(rows, cols) < 3 or max(rows, cols) > 200:
        raise UsageError(f"a grid of markers has 3 to 200 rows and columns, got {rows} × {cols}")
    return [(rows, cols), (cols, rows)] if either_way and rows != cols else [(rows, cols)]


def _likely(dots: Dots) -> Dots:
    """Without slivers and blots, and not more than can be meant."""
    if len(dots) > _MOST:
        dots = dots.only(np.sort(np.argsort(-dots.peaks, kind="stable")[:_MOST]))
    if len(dots) < 9:
        return dots
    middle = np.median(dots.areas)
    return dots.only((dots.areas > 0.3 * middle) & (dots.areas < 3 * middle))


def _distrust(lattice: Lattice | None, dots: Dots, polarity: Polarity) -> str:
    """Why this is no grid of markers; empty when it may be one."""
    if lattice is None or lattice.unevenness > _UNEVEN:
        return f"no regular grid of markers found in the image{_hint(polarity)}"
    between = _between(lattice, dots)
    if between > _BETWEEN * lattice.found:
        return (
            f"{between} dots lie between the lines of the {lattice.found} that form a grid: "
            "no markers, or a grid turned by more than 30° in the image"
        )
    return ""


def _between(lattice: Lattice, dots: Dots) -> int:
    """How many dots lie among those of the grid but are none of them: of a grid of diagonals, as many as it has."""
    number = lattice.dots[lattice.dots >= 0]
    low, high = dots.centers[number].min(axis=0), dots.centers[number].max(axis=0)
    among = ((dots.centers > low) & (dots.centers < high)).all(axis=1)
    among[number] = False
    return int(among.sum())


def _radius(dots: Dots, lattice: Lattice) -> float:
    return float(np.sqrt(np.median(dots.areas[lattice.dots[lattice.dots >= 0]]) / np.pi))


def _full(lattice: Lattice, dots: Dots) -> NDArray[np.float64]:
    """1 at nodes with a whole dot, a little at nodes with a cut one, 0 elsewhere, shape (lines, columns)."""
    there = lattice.dots >= 0
    return np.where(there, np.where(dots.inside[lattice.dots], 1.0, 0.01), 0.0)


def _search(image: NDArray[np.uint8], looks: tuple[Look, ...]) -> tuple[Look, float, float] | None:
    """The look, radius and spacing [px] that give the best grid: many dots, few gaps, even steps, clear dots."""
    best, best_score = None, 0.0
    for look in looks:
        for radius in _RADII:
            response = contrast(image, look, round(5 * radius))
            dots = _likely(find_dots(response, radius=radius, apart=1.5 * radius))
            lattice = grow(dots.centers)
            if lattice is None or lattice.unevenness > _UNEVEN or _are_gaps(response, dots, lattice):
                continue
            full = _full(lattice, dots)
            top, bottom, left, right = _trim(full)
            inner = full[top:bottom, left:right]
            texture = 1.5 * float(np.median(np.abs(response[::3, ::3]))) + 1e-3
            clear = float(np.median(dots.peaks[lattice.dots[lattice.dots >= 0]])) / texture
            share = float(inner.mean())
            score = float(inner.sum()) * share * (1 - lattice.unevenness / _UNEVEN) * clear / (clear + 4)
            if score > best_score:
                best, best_score = (look, _radius(dots, lattice), lattice.spacing), score
            if clear > 4 and share > 0.85 and lattice.unevenness < 0.5 * _UNEVEN and inner.sum() > 0.8 * len(dots):
                return best
    return best


def _are_gaps(response: NDArray[np.float32], dots: Dots, lattice: Lattice) -> bool:
    """Whether this is the grid of the gaps between dots, which are a little brighter than the mean of dots and gel.

    Then the opposite contrast, that of the dots, is by far the larger one.
    """
    opposite = -float(np.quantile(response[::3, ::3], 0.01))
    return float(np.median(dots.peaks[lattice.dots[lattice.dots >= 0]])) < 0.5 * opposite


def _trim(full: NDArray[np.float64]) -> tuple[int, int, int, int]:
    """The part of the grid whose outer lines are mostly there: top, bottom, left, right."""
    top, bottom, left, right = 0, full.shape[0], 0, full.shape[1]
    while bottom - top >= 3 and right - left >= 3:
        part = full[top:bottom, left:right]
        lines, columns = part.mean(axis=1), part.mean(axis=0)
        edges = (lines[0], lines[-1], columns[0], columns[-1])
        worst = int(np.argmin(edges))
        if edges[worst] >= 0.6:
            break
        top, bottom = top + (worst == 0), bottom - (worst == 1)
        left, right = left + (worst == 2), right - (worst == 3)
    return top, bottom, left, right


def _best(full: NDArray[np.float64], rows: int, cols: int) -> tuple[float, int, int, float]:
    """Most dots in a window of rows × cols: (how many, its top, its left, how many in the next best)."""
    if rows > full.shape[0] or cols > full.shape[1]:
        return 0.0, 0, 0, 0.0
    total = np.pad(full.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    sums = total[rows:, cols:] - total[:-rows, cols:] - total[rows:, :-cols] + total[:-rows, :-cols]
    top, left = np.unravel_index(int(sums.argmax()), sums.shape)
    others = np.delete(sums.reshape(-1), int(sums.argmax()))
    return float(sums.max()), int(top), int(left), float(others.max()) if len(others) else 0.0


def _window(
    lattice: Lattice, dots: Dots, rows: int | None, cols: int | None, wanted: list[tuple[int, int]]
) -> tuple[str, Lattice | None]:
    """The part of `lattice` that is the printed grid; none, and why, when that is not clear."""
    full = _full(lattice, dots)
    top, bottom, left, right = _trim(full)
    if not wanted:
        if bottom - top < 3 or right - left < 3:
            return "the grid of markers in the image has fewer than 3 × 3 whole dots", None
        return "", Lattice(lattice.dots[top:bottom, left:right], lattice.spacing, lattice.unevenness)
    size, window = max(((size, _best(full, *size)) for size in wanted), key=lambda choice: choice[1][0])
    count, top_best, left_best, second = window
    seen = f"the image shows {bottom - top} lines of {right - left} whole markers, not the {rows} × {cols} asked for"
    if count < 0.7 * size[0] * size[1]:
        return f"{seen}: correct rows and columns, or leave them out to have them found", None
    if count - second < 0.25 * min(size):
        return f"{seen}, and which lines to leave out is not clear: correct rows and columns", None
    part = lattice.dots[top_best : top_best + size[0], left_best : left_best + size[1]]
    return "", Lattice(part, lattice.spacing, lattice.unevenness)


def _found(look: Look, lattice: Lattice, dots: Dots) -> Found:
    number = lattice.dots
    middle = float(np.median(dots.areas[number[number >= 0]]))
    area = dots.areas[number]
    seen = (number >= 0) & dots.inside[number] & (area > 0.4 * middle) & (area < 2.0 * middle)
    positions = _interpolate(dots.centers[number], number >= 0)
    return Found(look, float(np.sqrt(middle / np.pi)), lattice.spacing, positions, seen)


def _interpolate(positions: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Fills in unknown nodes: the plane through all nodes, corrected by how the known neighbours deviate from it."""
    line, column = np.meshgrid(*(np.arange(n, dtype=float) for n in known.shape), indexing="ij")
    terms = np.stack([np.ones_like(line), line, column, line * column], axis=-1)
    plane = terms @ np.linalg.lstsq(terms[known], positions[known], rcond=None)[0]
    off = fill(positions - plane, known)
    return np.where(known[..., None], positions, plane + off)
