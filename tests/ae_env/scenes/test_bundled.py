"""Bundled scenes: statistics, splits, determinism, cache."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.bundled import procedural_groups
from simulator.camera import get_camera
from simulator.radiance.photographs import PHOTOGRAPHS, unprocess
from simulator.radiance.procedural import HARD_KINDS, dead_leaves, draw, list_kinds
from simulator.utils.cache import disk_cache

CAMERA = get_camera("nikon_z6")
WHITE = 100 * 2.5 / (120 * np.pi)  # signal of a white surface at the incident-light exposure


@pytest.fixture(scope="module")
def unseen(tmp_path_factory: pytest.TempPathFactory) -> list[Scene]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AE_ENV_CACHE", str(tmp_path_factory.mktemp("bundled")))
        return load_scenes("bundled", "test", camera=CAMERA)


def slope(picture: np.ndarray) -> float:
    """Exponent of the radial power spectrum over 4 to 64 cycles per picture."""
    size = picture.shape[0]
    window = np.outer(np.hanning(size), np.hanning(size))
    power = np.abs(np.fft.fft2((picture - picture.mean()) * window)) ** 2
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(size, 1 / size)] * 2))
    bands = np.arange(4, 65)
    mean = [power[np.abs(frequency - band) < 0.5].mean() for band in bands]
    return float(np.polyfit(np.log(bands), np.log(mean), 1)[0])


def test_dead_leaves_have_the_spectrum_of_nature() -> None:
    """Field 1987, Ruderman 1997: the power of natural pictures falls about as f**-2."""
    slopes = [slope(dead_leaves(np.random.default_rng(i), 256)[1]) for i in range(8)]
    assert np.mean(slopes) == pytest.approx(-2.0, abs=0.25)


def test_split_has_enough_groups_and_half_of_them_are_hard(unseen: list[Scene]) -> None:
    groups = {scene.group: scene.hard for scene in unseen}
    assert len(groups) >= 90
    assert 0.4 <= np.mean(list(groups.values())) <= 0.6
    for scene in unseen:
        assert scene.hard == (scene.kind in HARD_KINDS)
        assert (scene.light.shape, scene.box_factor) == ((4, 64, 64), 4)
        assert scene.noise_free
        assert scene.light.min() >= 0
        assert scene.median_speed == (1.0 if scene.kind == "motion" else 0.125)
    assert len({scene.scene_id for scene in unseen}) == len(unseen)


def test_splits_share_no_group(unseen: list[Scene]) -> None:
    train = {f"{kind}-{index:03d}" for kind, index in procedural_groups("train", "large")}
    train |= {p.name for p in PHOTOGRAPHS if p.split == "train"}
    assert len(train) >= 195
    assert not train & {scene.group for scene in unseen}


def test_hard_kinds_fool_a_meter_and_easy_ones_do_not(unseen: list[Scene]) -> None:
    """By how many EV one on the mean of the clipped frame would expose too little."""
    errors = {
        kind: np.log2([s.light[1].clamp(max=1.0).mean() / 0.12 for s in unseen if s.kind == kind])
        for kind in (*list_kinds(), "photograph")
    }
    for kind in ("dead_leaves", "indoor", "motion", "photograph"):
        assert abs(np.median(errors[kind])) < 0.35, kind
    assert np.all(errors["snow"] > 1.5)
    assert np.median(errors["back_light"]) > 1.2
    assert np.median(errors["night"]) < -1.2
    assert np.median(errors["spot_light"]) < -1.5
    assert max(np.abs(e).max() for e in errors.values()) < 5.0


def test_hard_kinds_are_what_they_say(unseen: list[Scene]) -> None:
    for scene in unseen:
        reflectance = scene.light[1] / WHITE
        if scene.kind == "snow":
            assert 0.7 <= reflectance.median() <= 0.95
            assert 0.6 <= reflectance.mean() <= 0.95
        if scene.kind == "night":
            assert 1 <= (scene.illuminance or 0.0) <= 50
            assert reflectance.max() > 5
            assert (scene.light.amax(dim=0) > 1).float().mean() < 0.08
        if scene.kind == "back_light":
            assert 0.1 < (reflectance > 1.0).float().mean() < 0.75
        if scene.kind == "spot_light":
            assert reflectance.median() < 0.02


def test_a_scene_is_the_same_wherever_it_is_asked_for(unseen: list[Scene]) -> None:
    small = load_scenes("bundled:small", "all", camera=CAMERA)
    assert len({s.group for s in small}) == 2 * 2 * 8
    by_id = {scene.scene_id: scene for scene in unseen}
    shared = [scene for scene in small if scene.scene_id in by_id]
    assert len(shared) == 2 * 7 + 2 * 3
    for scene in shared:
        assert torch.equal(scene.light, by_id[scene.scene_id].light)
        assert scene.reference == by_id[scene.scene_id].reference


def test_drawing_depends_on_the_generator_alone() -> None:
    for kind in list_kinds():
        first, second, other = (draw(kind, np.random.default_rng(i), 64) for i in (5, 5, 6))
        assert np.array_equal(first.light, second.light)
        assert first.illuminance == second.illuminance
        assert not np.array_equal(first.light, other.light)
        assert first.light.dtype == np.float32
    with pytest.raises(ValueError, match="did you mean 'night'"):
        draw("nights", np.random.default_rng(0))


def test_unprocess_inverts_tone_and_gamma() -> None:
    """0.5 is a fixed point of the tone curve; sRGB 0.5 is 0.2140 linear (IEC 61966-2-1)."""
    rng = np.random.default_rng(0)
    grey = unprocess(np.full((64, 64), 127, np.uint8), rng)
    grey += unprocess(np.full((64, 64), 128, np.uint8), rng)
    assert grey.mean() / 2 == pytest.approx(0.2140, abs=2e-4)
    assert grey.std() > 1e-4  # dithered
    shown = np.random.default_rng(1).integers(10, 240, (32, 32, 3)).astype(np.uint8)
    flat = unprocess(shown, rng).transpose(1, 2, 0).astype(float)
    gamma = np.where(flat <= 0.0031308, 12.92 * flat, 1.055 * flat ** (1 / 2.4) - 0.055)
    again = 3 * gamma**2 - 2 * gamma**3  # the smooth step of Brooks et al. 2019
    assert np.abs(again * 255 - shown).max() <= 0.51
    with pytest.raises(ValueError, match="`image`"):
        unprocess(np.zeros((4, 4)), rng)


def test_cached_scenes_equal_fresh_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    caplog.set_level(logging.INFO)

    def load() -> list[Scene]:
        caplog.clear()
        return load_scenes("bundled:snow", "test", camera=CAMERA, resolution=36)

    fresh = load()
    (file,) = (tmp_path / "scenes").glob("*.safetensors")
    content, cache, key = file.read_bytes(), disk_cache(), f"scenes/{file.stem}"
    stored = cache.get(key)
    for a, b in zip(fresh, load(), strict=True):
        assert torch.equal(a.light, b.light)
        assert a.content == b.content  # of the light and the layout
        assert vars(replace(a, light=b.light, layout=b.layout)) == vars(replace(b))
    assert not caplog.records
    light = stored["light"]
    nan = torch.where(light == light.max(), torch.nan, light)
    whole = nan, light[1:], light[..., :30]  # files that cannot be right
    for damaged in (content[: len(content) // 2], b"", content[:-3] + b"abc", *whole):
        if isinstance(damaged, bytes):
            file.write_bytes(damaged)
        else:
            cache.put(key, {**stored, "light": damaged})
        again = load()
        assert "damaged" in caplog.text
        assert all(torch.equal(a.light, b.light) for a, b in zip(fresh, again, strict=True))
    load()
    assert not caplog.records
