"""What tests of triangulation share."""

from collections.abc import Iterator

import pytest
from solvers import WAYS, by


@pytest.fixture(scope="module", params=WAYS)
def way(request: pytest.FixtureRequest) -> Iterator[str]:
    """Both ways to triangulate, the short one of few points and the long one, one at a time.

    Of a module, so that examples drawn for one test may share it.
    """
    with by(request.param):
        yield request.param
