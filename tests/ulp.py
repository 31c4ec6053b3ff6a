"""Every matrix product moved by the rounding that no BLAS promises: `python -m pytest -p tests.ulp`.

An entry of a result goes to the float above, to the one below or stays, by its place and the result's size: the same
call gives the same bits, as on any processor, but equal rows of a product differ in the last place. A test that fails
under this asks for bits where it should ask for values. Scripts in processes of their own see nothing of it, so a test
that compares one with this process is skipped.
"""

import pytest
import torch
from torch.nn import functional as F


def off_by_one_ulp(product):
    def moved(*args, **kwargs):
        result = product(*args, **kwargs)
        exact, size = result.detach(), result.numel()
        way = (torch.arange(size, 2 * size, device=exact.device).sin() * 1e4).round() % 3  # 0, 1 or 2
        way = (way - 1).reshape(exact.shape).to(exact.dtype)
        offset = torch.nextafter(exact, way * torch.finfo(exact.dtype).max) - exact
        return result + (way.abs() * offset).nan_to_num(0.0, 0.0, 0.0)  # nothing for inf

    return moved


F.linear, torch.bmm, torch.baddbmm = map(off_by_one_ulp, (F.linear, torch.bmm, torch.baddbmm))


def pytest_collection_modifyitems(items):
    for item in items:
        if getattr(item, "originalname", None) == "test_killed_and_resumed_equals_undisturbed":
            item.add_marker(pytest.mark.skip(reason="its first part is a process of its own, unmoved"))
