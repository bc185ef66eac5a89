"""What all tests share: pictures without a display, and examples that are the same on every machine."""

import os

from hypothesis import settings

os.environ.setdefault("MPLBACKEND", "Agg")

# No deadline: no test depends on how fast the machine is. The same examples each time: a red run can be repeated.
settings.register_profile("gelflow", deadline=None, derandomize=True)
settings.load_profile("gelflow")
