"""Every test that takes ``device`` runs on every device there is."""

import pytest
import warp as wp

wp.config.quiet = True
wp.init()


@pytest.fixture(params=["cpu", *(str(device) for device in wp.get_cuda_devices())])
def device(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def rng():
    import numpy as np

    return np.random.default_rng(20130705)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A new folder, and the working one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
