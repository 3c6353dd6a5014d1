"""Raws, prepared scenes and scenes as light."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from simulator import CameraProfile, CameraSettings, NoiseLevelFunction, RawImage, get_camera
from simulator.camera_simulator import prepared_of

CPU = torch.device("cpu")
SETTINGS = CameraSettings(400, 1 / 64, 4)


def raw(**changes: object) -> RawImage:
    data = torch.rand(4, 6, 8, generator=torch.Generator().manual_seed(0)) * 0.9
    return replace(RawImage(data, SETTINGS, get_camera("nikon_z6")), **changes)  # type: ignore[arg-type]


def test_a_raw_keeps_its_light_and_noise() -> None:
    source = raw(white_balance=(2.0, 1.0, 1.5), box_factor=2)
    prepared = prepared_of(source, CPU)
    assert torch.equal(prepared.light, source.data)
    assert (prepared.reference, prepared.camera) == (SETTINGS, source.camera)
    assert prepared.nlf == source.noise
    assert (prepared.white_balance, prepared.box_factor) == ((2.0, 1.0, 1.5), 2)
    assert prepared.saturated is None
    assert prepared.denoised is None


def test_saturated_pixels_are_marked() -> None:
    data = raw().data.clone()
    data[2, 1, 3] = 1.0
    saturated = prepared_of(raw(data=data), CPU).saturated
    assert saturated is not None
    assert saturated.nonzero().tolist() == [[1, 3]]


def test_noise_of_an_uncalibrated_camera_is_the_raws() -> None:
    camera = CameraProfile("unknown", "RGGB", 64.0, 1023, 10)  # type: ignore[arg-type]
    own = NoiseLevelFunction((1e-4,) * 4, (1e-6,) * 4)
    assert prepared_of(raw(camera=camera, nlf=own), CPU).camera.nlf(400) == own


def test_prepared_scenes_and_scenes_share_what_is_known() -> None:
    prepared = replace(prepared_of(raw(), CPU), image_speed=0.5, tolerance=0.0)
    for source in (prepared, SimpleNamespace(prepared=prepared)):
        found = prepared_of(source, CPU)
        assert found.light is prepared.light
        assert found.statistics is prepared.statistics
        assert found.blurred_light is prepared.blurred_light
        assert (found.image_speed, found.tolerance) == (0.5, 0.0)


def test_anything_else_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"`source` \(=Tensor\) must be a RawImage, a PreparedScene or"
    ):
        prepared_of(torch.zeros(4, 2, 2), CPU)  # type: ignore[arg-type]
