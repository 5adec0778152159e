"""Devices to test on, and Hypothesis without a deadline: the first call of an operator compiles its kernels."""

from functools import cache

import pytest
from hypothesis import settings

settings.register_profile("warpfrag", deadline=None)
settings.load_profile("warpfrag")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every test that takes a `device` on the CPU, and on the first GPU where there is one."""
    if "device" in metafunc.fixturenames:
        metafunc.parametrize("device", devices())


@cache
def devices() -> list[str]:
    """Return the devices; asked only when a test wants one, as Warp starts up for it."""
    import warp as wp

    return ["cpu", "cuda:0"] if wp.is_cuda_available() else ["cpu"]
