"""Networks run once for one result, and again for whatever could change it."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from simulator import CameraSettings, CameraSimulator, PreparedScene, RawImage, get_camera
from simulator.networks.network_cache import NetworkCache
from simulator.utils.cache import disk_cache

CAMERA = get_camera("nikon_z6")
SOURCE = CameraSettings(6400, 1 / 1024, 8)


def counted(simulator: CameraSimulator) -> list[int]:
    """One entry for each run of a simulator's networks."""
    runs: list[int] = []
    networks = simulator.noise.network.tail, simulator.aperture.network
    for network in networks:  # not where operations are counted
        network.register_forward_hook(lambda _m, _in, out: None if out.is_meta else runs.append(1))
    return runs


def _raw(seed: int = 0, size: int = 24) -> RawImage:
    light = 0.1 + 0.2 * torch.rand(
        (4, size, size + 4), generator=torch.Generator().manual_seed(seed)
    )
    return RawImage(light, SOURCE, CAMERA)


def _simulator(**options: Any) -> CameraSimulator:
    torch.manual_seed(0)
    made = CameraSimulator("nano", device="cpu", **options)
    torch.nn.init.normal_(made.noise.network.tail.weight)
    return made


def _denoised(simulator: CameraSimulator, source: RawImage | PreparedScene) -> torch.Tensor:
    (found,) = simulator.prepare(source).denoised_lights
    return found.light


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("depth", ["far", "unknown"])
def test_what_is_found_again_is_the_same_bit_by_bit(folder: Path, depth: Any) -> None:
    raw = _raw()
    made = _simulator(cache=None).prepare(raw, depth=depth)
    keeper, later = _simulator(cache="disk"), _simulator(cache="disk")
    found = [keeper.prepare(raw, depth=depth) for _ in range(2)]
    runs = counted(later)
    found.append(later.prepare(raw, depth=depth))
    assert not runs
    for prepared in found:
        light, expected = prepared.denoised_lights[0].light, made.denoised_lights[0].light
        assert torch.equal(light, expected)
        assert light.stride() == expected.stride()
        if depth == "unknown":
            assert torch.equal(prepared.aperture_blur.diameter, made.aperture_blur.diameter)


def test_without_a_cache_the_networks_run_every_time(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"`cache` \(='ram'\) must be one of None"):
        _simulator(cache="ram")
    _denoised(_simulator(), _raw())  # in memory only
    simulator = _simulator(cache=None)
    runs = counted(simulator)
    _denoised(simulator, _raw())
    once = len(runs)
    _denoised(simulator, _raw())
    assert len(runs) == 2 * once > 0
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("where", ["memory", "disk"])
def test_everything_that_changes_the_result_is_seen(where: Any, folder: Path) -> None:
    simulator, raw = _simulator(cache=where), _raw()
    runs = counted(simulator)
    brighter = raw.data.clone()
    brighter[3, 5, 7] += 1e-6
    sources = [raw, replace(raw, data=brighter), replace(raw, nlf=CAMERA.nlf(6400).scaled(2.0))]
    sources.append(replace(raw, data=raw.data.reshape(4, 28, 24)))
    for other, precision in [(source, "float32") for source in sources] + [(raw, "bfloat16")]:
        simulator.precision = precision
        before = len(runs)
        _denoised(simulator, other)
        assert len(runs) > before, other
    simulator.precision, before = "float32", len(runs)
    _denoised(simulator, replace(raw, data=raw.data.clone()))  # another object, the same content
    assert len(runs) == before


@pytest.mark.parametrize("change", ["plain", "fused", "loaded", "data", "module"])
def test_other_weights_are_seen(change: str) -> None:
    """A step of training, or whatever else changes weights where they are."""
    simulator, raw = _simulator(), _raw()
    before = _denoised(simulator, raw)
    if change == "module":
        simulator.noises = (copy.deepcopy(simulator.noises[0]),)
    module = simulator.noise
    assert module is not None
    if change in ("plain", "fused"):
        module.requires_grad_(True)
        optimiser = torch.optim.Adam(module.parameters(), lr=1e-3, fused=change == "fused")
        for p in module.parameters():
            p.grad = torch.ones_like(p)
        optimiser.step()
        module.requires_grad_(False)
    elif change == "loaded":
        module.load_state_dict({k: 1.01 * v for k, v in module.state_dict().items()})
    else:
        next(iter(module.parameters())).data.mul_(1.01)
    after = _denoised(simulator, raw)
    assert torch.equal(after, simulator.denoise(simulator.prepare(raw)))
    assert not torch.equal(after, before)


def test_a_result_changed_in_place_is_made_again() -> None:
    simulator, raw = _simulator(), _raw()
    expected = _denoised(simulator, raw).clone()
    _denoised(simulator, raw).mul_(2.0)
    assert torch.equal(_denoised(simulator, raw), expected)


@pytest.mark.parametrize("wrong", [torch.zeros(4, 3), torch.full((1, 2, 3), torch.nan)])
def test_an_implausible_result_on_disk_is_made_again(wrong: torch.Tensor, folder: Path) -> None:
    module, image = nn.Identity(), torch.ones(1, 2, 3)
    module.weight = nn.Parameter(torch.ones(1))
    cache = NetworkCache("disk")
    assert torch.equal(cache.called("opened", module, image), image)
    (file,) = (folder / "opened").iterdir()
    disk_cache().put(f"opened/{file.stem}", {"result": wrong})
    assert torch.equal(NetworkCache("disk").called("opened", module, image), image)
