"""Episodes of one policy in words and pictures, as a page shows them."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class ShownEpisodes:
    """Episodes of one policy."""

    text: str  # results in words, Markdown
    failures: Image | None  # where failures lie; None without randomized quantities
    films: dict[str, list[Image]] = field(default_factory=dict)  # "success" and "failure", as far as there are any
    frames_per_second: float = 1.0
