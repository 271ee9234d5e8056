"""What tests of the plugin share."""

import pytest

from puncture_twin.meshes import folder
from puncture_twin.planning.search.context import prepare


@pytest.fixture(scope="session")
def kernels_loaded():
    """Run compiled code once: pytester forgets modules that it saw imported, and numba's register only once."""
    import puncture_twin.planning.collision_cases.collector  # noqa: F401  # and OMPL, which loads once too

    prepare(folder() / "carton" / "case_m.toml", arm=False).check(0.0, 0.0)
