"""What all tests share: hypothesis profiles, the dtypes, the real captures."""

import gc
import os
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings

# The same examples every time: a red test is then about the change, not about luck. Nights draw
# anew, as should a change to the numerics: pytest --hypothesis-profile=thorough
settings.register_profile(
    "same",
    deadline=None,
    max_examples=25,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile(
    "thorough", settings.get_profile("same"), max_examples=1000, derandomize=False
)
settings.load_profile("same")
# Without bytecode each process of tests, and each command that they start, would compile a thousand
# files anew, for ten seconds and for one.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# Test tensors are small: a second thread costs more than it brings.
torch.set_num_threads(1)
# Commands that tests start share the cores with the other processes that run tests.
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    share = (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, share)))
# The half million objects of imports and tests never go, and are not to be looked through again.
gc.set_threshold(10_000, 20, 20)


def pytest_collection_finish() -> None:
    """The tests are there, and stay."""
    gc.collect()
    gc.freeze()


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
