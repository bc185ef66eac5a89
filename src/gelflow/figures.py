"""Colours, logarithmic axes, flow maps and files of all figures."""

import contextlib
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid

BLUE, VERMILION, GREEN, PURPLE, ORANGE = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00"  # Okabe and Ito
SKY_BLUE = "#56B4E9"  # the same
SERIES = ((BLUE, "o"), (VERMILION, "s"), (GREEN, "^"), ("black", "D"), (PURPLE, "v"), (ORANGE, "P"))  # colour, marker
PICTURE_FORMATS = (".png", ".jpg", ".jpeg", ".pdf", ".svg")  # suffixes of files that `save` writes
_ARROW = 1.4  # length of the longest arrow of a flow map, in grid pitches


def set_log_axis(axes: Any, which: str, subs: tuple[int, ...] = (1, 2, 5)) -> None:
    """Make the axis "x" or "y" logarithmic, with labels in plain numbers at `subs` times powers of ten."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter  # deferred: slow to import

    axes.set(**{f"{which}scale": "log"})
    axis = getattr(axes, f"{which}axis")
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def draw_flow_map(axes: Any, grid: Grid, flow: NDArray[np.floating[Any]]) -> None:
    """Draw the flow map of one pad as arrows, seen from outside, fingertip down: x points down and y to the right.

    `flow` are the vectors (x, y), shape (2, rows * cols), whose longest has length 1.
    """
    add_arrows(axes, grid, flow, color=BLUE, width=0.008)
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.invert_yaxis()
    axes.margins(0.18)


def add_arrows(axes: Any, grid: Grid, flow: NDArray[np.floating[Any]], *, color: str, width: float) -> None:
    """Add the arrows of a flow map, as in `draw_flow_map`; `width` is relative to the width of the axes."""
    down, right = flow * grid.pitch * _ARROW
    x, y = grid.positions().T
    axes.quiver(y, x, right, down, color=color, angles="xy", scale_units="xy", scale=1, width=width)


def rasterize(figure: Any) -> NDArray[np.uint8]:
    """A matplotlib figure as RGB pixels, shape (height, width, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # deferred: slow to import

    canvas: Any = FigureCanvasAgg
    drawn = canvas(figure)
    drawn.draw()
    return np.array(drawn.buffer_rgba(), dtype=np.uint8)[..., :3].copy()


def save(figure: Any, path: str | Path, *, dpi: int = 100, make_folder: bool = True) -> None:
    """Write a matplotlib figure. Raises UsageError when the file cannot be written; a part of a new file is deleted."""
    new = not os.path.lexists(path)
    try:
        if make_folder:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=dpi)
    except (OSError, ValueError) as error:  # ValueError: unknown format
        if new:
            with contextlib.suppress(OSError):
                Path(path).unlink()
        raise UsageError(f"cannot write the picture {path}: {error}; name a .png in a writable folder") from error
