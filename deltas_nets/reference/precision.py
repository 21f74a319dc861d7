"""The reference network computes in float32, whatever precision caller or device prefer."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def full_precision(device: torch.device) -> Iterator[None]:
    """Neither TF32, which convolutions on a GPU use unasked, nor the caller's autocast.

    Args:
        device: of the computation.
    """
    with torch.autocast(device.type, enabled=False):
        if not hasattr(torch.backends.cudnn, "conv"):  # torch before 2.9
            with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
                yield
            return
        # Unlike the flags before it, this setting can be put back whichever way it was made.
        operations = (torch.backends.cudnn.conv, torch.backends.cuda.matmul)
        before = [operation.fp32_precision for operation in operations]
        try:
            for operation in operations:
                operation.fp32_precision = "ieee"
            yield
        finally:
            for operation, precision in zip(operations, before, strict=True):
                operation.fp32_precision = precision
