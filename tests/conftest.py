"""What all tests share: hypothesis profiles, the dtypes, the real captures."""

import os
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings

settings.register_profile(
    "local", deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("ci", settings.get_profile("local"), derandomize=True)
# For a night, or after a change to the numerics: pytest --hypothesis-profile=thorough
settings.register_profile("thorough", settings.get_profile("local"), max_examples=1000)
# Test tensors are small: a second thread costs more than it brings.
torch.set_num_threads(1)
settings.load_profile("ci" if os.environ.get("CI") else "local")


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    """Both floating types that every operation supports."""
    chosen: torch.dtype = request.param
    return chosen


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real captures beside the repository; tests that need them are skipped elsewhere."""
    folder = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"needs the captures in {folder}")
    return folder
