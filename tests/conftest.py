"""What all tests share: pictures without a display, and examples that are the same on every machine."""

import os
from collections.abc import Iterator

import pytest
from hypothesis import settings

os.environ.setdefault("MPLBACKEND", "Agg")

# No deadline: no test depends on how fast the machine is. The same examples each time: a red run can be repeated.
settings.register_profile("gelflow", deadline=None, derandomize=True)
settings.load_profile("gelflow")


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Grids of meshes are kept in a folder of this run, not in the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GELFLOW_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
