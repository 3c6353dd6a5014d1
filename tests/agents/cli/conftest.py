"""A raw to give to the command line."""

from pathlib import Path

import numpy as np
import pytest

from simulator import CameraSettings, RawImage, get_camera, write_dng


@pytest.fixture(scope="module")
def raw() -> RawImage:
    rows, columns = np.mgrid[0:100, 0:120]
    light = 0.04 + 0.2 * (rows / 100) + 0.1 * ((rows // 20 + columns // 20) % 2)
    data = np.tile(light.astype(np.float32), (4, 1, 1))
    settings = CameraSettings(iso=400, exposure_time=1 / 64, f_number=5.6)
    return RawImage(data, settings, get_camera("nikon_z6"), white_balance=(2.0, 1.0, 1.5))


@pytest.fixture
def dng(raw: RawImage, tmp_path: Path) -> Path:
    write_dng(tmp_path / "IMG_1.dng", raw)
    return tmp_path / "IMG_1.dng"
