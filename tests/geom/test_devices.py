"""Every operation on a device that is not the host's, forward and back.

What follows from inputs stays where they are, and nothing waits for the device: no value is read
from it, and no number of the host copied to it where that has to be waited for.
"""

import pytest
import torch
from operations import METHODS, OPERATIONS, Inputs, chosen, followed, inputs_in, tensors_of
from stand_in_device import DEVICE, MixedDevices, on_device, one_device, to_device

from deltas_geom.cameras.lenses import inverse, undistort
from deltas_geom.testing.fixed_scenes import seeded_scene

# How long tracks are decides what is computed at a time: these read indices, and say so.
GROUP = {"refine_tracks", "track_covariance", "triangulate_robust_tracks"}


@pytest.fixture(autouse=True)
def few_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Turns of a loop have the same operations: three tell what sixty do."""
    for module, name in ((inverse, "_BRACKETED"), (inverse, "_CAREFUL"), (undistort, "_HALVINGS")):
        monkeypatch.setattr(module, name, 3)


def there_and_back(name: str, dtype: torch.dtype) -> list[str]:
    """The copies between host and device; asserts that all there is stays on the device."""
    operation = (OPERATIONS | METHODS)[name]
    given: Inputs = to_device(followed(chosen(operation, inputs_in(dtype))))
    with one_device() as copies:
        found = tensors_of(operation(**given))
        with_gradient = [tensor for tensor in found if tensor.requires_grad]
        if with_gradient:
            sum((tensor.sum() for tensor in with_gradient), found[0].new_zeros(())).backward()
        with torch.no_grad():  # some take a faster route then
            operation(**given)
    assert found and on_device(found)
    assert all(tensor.dtype == dtype for tensor in found if tensor.is_floating_point())
    gradients = [tensor.grad for tensor in given.values()]
    assert on_device(gradients)
    assert bool(with_gradient) == any(gradient is not None for gradient in gradients)
    return copies


# In float64 there are the same operations but the casts.
@pytest.mark.parametrize(
    "dtype", [torch.float32, pytest.param(torch.float64, marks=pytest.mark.slow)], ids=str
)
@pytest.mark.parametrize("name", [name for name in (*OPERATIONS, *METHODS) if name not in GROUP])
def test_an_operation_stays_on_the_device_and_waits_for_nothing(
    name: str, dtype: torch.dtype
) -> None:
    assert there_and_back(name, dtype) == []


def test_checking_values_is_apart_because_it_reads_them() -> None:
    views = to_device(seeded_scene(0).views)
    with one_device(), pytest.raises(RuntimeError, match="meta"):
        views.check_values()


def test_what_a_gpu_would_refuse_is_noticed() -> None:
    there, here = torch.ones(3, device=DEVICE), torch.ones(3)
    with one_device() as copies:
        with pytest.raises(MixedDevices, match="aten::add"):
            there + here
        with pytest.raises(RuntimeError, match="meta"):
            bool(there.sum() > 0)
        with pytest.raises((RuntimeError, NotImplementedError), match="meta"):
            there[there > 0]
        assert not copies
        here.to(DEVICE)
        there.new_tensor([1.0])
        there[[0, 2]]
        there[torch.tensor([0, 2])]
    assert copies == ["aten::_to_copy", "new_tensor", "__getitem__", "aten::index"]
