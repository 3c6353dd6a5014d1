"""Bundled scenes and Poly Haven's: statistics, splits, depth, light, cache, downloads."""

import functools
import hashlib
import logging
import math
import threading
from collections import Counter
from dataclasses import replace
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import torch

from ae_env.lighting.moving import read_pans
from ae_env.scenes import bundled, polyhaven
from ae_env.scenes.load import load_scenes
from ae_env.scenes.polyhaven import Asset, list_assets
from ae_env.scenes.scene import SceneRequest
from examples.depth_scenes import depth_scenes
from simulator.camera import get_camera
from simulator.radiance.depth import FOCUSES, draw_depth, lens_and_depth
from simulator.radiance.incident_light import receptor_reading
from simulator.radiance.maps import perspective
from simulator.radiance.photographs import PHOTOGRAPHS, unprocess
from simulator.radiance.procedural import HARD_KINDS, KINDS, LeafStyle, dead_leaves
from simulator.radiance.reading import read_radiance
from simulator.utils.cache import LruCache, disk_cache
from tests.ae_env.environments import make_env
from tests.ae_env.scene_files import write_hdr
from tests.ae_env.scorer_images import make_scene

CAMERA = get_camera("nikon_z6")


@pytest.fixture(scope="module")
def unseen():
    """Every second scene to test on."""
    return bundled.bundled_scenes(SceneRequest("test", CAMERA))[::2]


def check_oracles_are_spread(scenes):
    """No value of a control is best in more than 60 % of the scenes."""
    size = scenes[0].light.shape[1]
    env = make_env(scenes=scenes, split="all", resolution=size).unwrapped
    states = []
    for i in range(len(scenes)):
        env.core.begin(np.array([0]), [np.random.default_rng(i)], [{"scene": i}])
        states.append(env.score_table().oracle)
    for control in env.grid.controls(np.array(states)).T:
        assert np.bincount(control).max() <= 0.6 * len(states)


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
    slopes = [slope(dead_leaves(np.random.default_rng(i), 256, LeafStyle())[1]) for i in range(8)]
    assert np.mean(slopes) == pytest.approx(-2.0, abs=0.25)
    # A value of the first release: the bundled scenes must not change.
    picture = dead_leaves(np.random.default_rng(7), 48, LeafStyle())
    mean = [0.15036413232802362, 0.16999628065968864, 0.15176365238261902]
    np.testing.assert_allclose(picture.mean(axis=(1, 2), dtype=float), mean, rtol=1e-5)


def test_splits_share_no_group_and_half_are_hard_which_fools_a_meter(unseen):
    known = {}  # the kind of each group
    for split in ("train", "test"):
        drawn = bundled.procedural_groups(split, "large")
        known[split] = {f"{kind}-{index:03d}": kind for kind, index in drawn}
        known[split] |= {p.name: "photograph" for p in PHOTOGRAPHS if p.split == split}
    train, test = known["train"], known["test"]
    assert len(train) >= 195 > len(test) >= 90
    assert not train.keys() & test.keys()
    assert 0.4 <= np.mean([kind in HARD_KINDS for kind in test.values()]) <= 0.6
    for scene in unseen:
        assert scene.kind == test[scene.group]
        assert scene.hard == (scene.kind in HARD_KINDS)
        assert (scene.light.shape, scene.box_factor) == ((4, 64, 64), 4)
        assert scene.noise_free
        assert scene.light.min() >= 0
        assert scene.median_speed == (1.0 if scene.kind == "motion" else 0.125)
    assert len({scene.scene_id for scene in unseen}) == len(unseen)
    # By how many EV a meter on the mean of the clipped frame would expose too little.
    errors = {
        kind: np.log2([s.light[1].clamp(max=1.0).mean() / 0.12 for s in unseen if s.kind == kind])
        for kind in (*KINDS, "photograph")
    }
    for kind in ("dead_leaves", "indoor", "motion", "photograph"):
        assert abs(np.median(errors[kind])) < 0.35, kind
    assert np.all(errors["snow"] > 1.5)
    assert np.median(errors["back_light"]) > 1.2
    assert np.median(errors["night"]) < -1.2
    assert np.median(errors["spot_light"]) < -1.5
    assert max(np.abs(e).max() for e in errors.values()) < 5.0
    check_oracles_are_spread(unseen)


def test_a_scene_is_the_same_wherever_it_is_asked_for(unseen):
    small = {s.scene_id: s for s in load_scenes("bundled:small", "test", camera=CAMERA)}
    assert len({s.group for s in small.values()}) == 2 * 8
    shared = [scene for scene in unseen if scene.scene_id in small]
    assert len(shared) >= 10
    for scene in shared:
        assert torch.equal(scene.light, small[scene.scene_id].light)
        assert scene.reference == small[scene.scene_id].reference


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


def test_cached_scenes_equal_fresh_ones(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    caplog.set_level(logging.INFO)

    def load():
        caplog.clear()
        return load_scenes("bundled:photograph", "test", camera=CAMERA, resolution=36)

    fresh = load()
    assert {scene.kind for scene in fresh} == {"photograph"}
    (file,) = (tmp_path / "scenes").glob("*.safetensors")
    cache, key = disk_cache(), f"scenes/{file.stem}"
    stored = cache.get(key)
    for a, b in zip(fresh, load(), strict=True):
        assert torch.equal(a.light, b.light)
        assert a.content == b.content  # of the light and the layout
        assert vars(replace(a, light=b.light, layout=b.layout)) == vars(replace(b))
    assert not caplog.records
    light = stored["light"]
    nan = torch.where(light == light.max(), torch.nan, light)
    for damaged in (nan, light[1:], light[..., :30]):  # files that cannot be right
        cache.put(key, {**stored, "light": damaged})
        again = load()
        assert "damaged" in caplog.text
        assert all(torch.equal(a.light, b.light) for a, b in zip(fresh, again, strict=True))
    load()
    assert not caplog.records


PITCH = 11.88e-6  # packed pixels of the Nikon Z6


def test_depth_gives_the_blur_back_by_the_thin_lens() -> None:
    """c = f^2 / (N (s - f)) |z - s| / z with f = 50 mm and N = 11, by hand."""
    # Slants and floating leaves reach at most 1.8 pixels past the level of the thing in focus.
    bounds = {"everything": (-0.31, 0.31), "front": (-2.0, 7.0), "back": (-7.0, 2.0)}
    for seed, focus in enumerate(FOCUSES * 4):
        picture = draw_depth(np.random.default_rng(seed), 48, focus)
        distance, z = lens_and_depth(picture.blur, picture.far, PITCH)
        z = z.astype(float)
        c = 0.05**2 / (11.0 * (distance - 0.05)) * (z - distance) / z / PITCH
        np.testing.assert_allclose(c, picture.blur, atol=2e-4)
        assert 0.5 < z.min() <= z.max() <= 51.0
        assert 1.0 / z.max() == pytest.approx(picture.far, rel=1e-4)
        low, high = bounds.get(focus, (-7.0, 7.0))
        assert low <= picture.blur.min() <= picture.blur.max() <= high


def test_layouts_depend_on_the_name_alone() -> None:
    """One scene has one layout at every resolution: the finer, averaged."""
    light = np.random.default_rng(0).random((4, 128, 128))
    named = ("a", light), ("a", light / 2), ("b", light), ("a", light[:, :64, :64])
    fine, again, other, small = (
        bundled.add_layout(make_scene(picture, 100.0, scene_id=name)) for name, picture in named
    )
    assert fine.layout.subject.any()
    assert torch.equal(fine.layout.defocus, again.layout.defocus)
    assert not torch.equal(fine.layout.defocus, other.layout.defocus)
    torch.testing.assert_close(fine.resized(64).layout.defocus, small.layout.defocus)
    front, *_ = depth_scenes(CAMERA)  # a layout that was measured
    assert front.scene_id == "motorcycle-front"
    assert front.layout.defocus.shape == front.layout.subject.shape == front.light.shape[1:]


def test_drawn_one_by_one_they_are_those_drawn_together(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    monkeypatch.setattr("ae_env.scenes.load._LOADED", LruCache(2**30))
    together = load_scenes("bundled:photograph", "test", camera=CAMERA, resolution=36)
    request, part = SceneRequest("test", CAMERA, 36), "photograph"
    loaded = bundled.bundled_scenes(request, part=part)
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "empty"))
    drawn = bundled.bundled_scenes(request, part=part)
    assert loaded.loaded == [0]
    assert 1 < len(drawn.loaded) < len(drawn)  # what cannot be drawn must fail at once
    assert list(drawn.scene_ids) == [scene.scene_id for scene in together]
    for index in np.random.default_rng(0).permutation(len(drawn)).tolist():
        for name in ("scene_id", "content", "reference", "ev100"):
            wanted = getattr(together[index], name)
            assert getattr(drawn[index], name) == getattr(loaded[index], name) == wanted
        assert drawn[index] is drawn[index]
    # The last one stores them.
    assert bundled.bundled_scenes(request, part=part).loaded == [0]
    assert drawn[-2:] == drawn[:][-2:]
    with pytest.raises(IndexError):
        drawn[len(drawn)]


def test_the_list_splits_places_and_each_kind_is_tested(tmp_path, monkeypatch):
    splits = {}
    for asset in list_assets():
        assert splits.setdefault(asset.place, asset.split) == asset.split
    assert len({a.name for a in list_assets()}) == len(list_assets()) >= 40
    tested = {a.kind for a in list_assets() if a.split == "test"}
    assert tested >= {"night", "indoor", "backlit", "forest", "sun", "overcast", "studio", "tunnel"}
    assert list(splits.values()).count("test") >= 15  # enough for intervals
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path))
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "none"))
    with pytest.raises(FileNotFoundError, match=r"27 of 27 maps .*ae-env scenes download"):
        load_scenes("polyhaven", "test", camera=CAMERA)
    with pytest.raises(FileNotFoundError, match=r"'mixed'\): 35 of 35 maps"):
        load_scenes("mixed", "train", camera=CAMERA)


def panorama(light) -> np.ndarray:
    """(3, 256, 512) grey light as a function of longitude and latitude [radians]."""
    longitude = (np.arange(512) + 0.5) / 512 * 2 * np.pi - np.pi
    latitude = np.pi / 2 - (np.arange(256) + 0.5) / 256 * np.pi
    grey = np.broadcast_to(light(longitude[None, :], latitude[:, None]), (256, 512))
    return np.repeat(grey[None], 3, axis=0).astype(np.float32)


def test_what_receptors_read_of_an_even_sky_a_half_sky_and_a_small_lamp():
    """In closed form: a dome reads (1 + cos) / 2 of a lamp, 2 pi of even light, 3 pi / 2 or pi / 2
    of the half sphere that it faces or turns from."""
    even = panorama(lambda lon, lat: 2.0 + 0.0 * lat + 0.0 * lon)
    sky = panorama(lambda lon, lat: (lat > 0) + 0.0 * lon)
    for azimuth, pitch in ((0, 90), (17, 0), (-120, 35), (0, -90)):
        assert receptor_reading(even, azimuth, pitch) == pytest.approx(4.0 * math.pi, rel=1e-4)
        flat = receptor_reading(even, azimuth, pitch, dome=False)
        assert flat == pytest.approx(2.0 * math.pi, rel=1e-4)
    for pitch, of_dome, of_flat in ((90, 1.5, 1.0), (0, 1.0, 0.5), (-90, 0.5, 0.0)):
        dome, flat = (receptor_reading(sky, 45, pitch, dome=is_dome) for is_dome in (True, False))
        assert dome == pytest.approx(of_dome * math.pi, rel=1e-3)
        assert flat == pytest.approx(of_flat * math.pi, rel=1e-3, abs=1e-6)
    at = math.radians(40), math.radians(20)

    def lamp(longitude, latitude):
        near = (abs(longitude - at[0]) < 0.03) & (abs(latitude - at[1]) < 0.03)
        return 500.0 * near

    light = panorama(lamp)
    straight = receptor_reading(light, 40, 20)
    for azimuth, pitch in ((40, 80), (70, 20), (40, -30), (-140, -20)):
        a, p = math.radians(azimuth) - at[0], math.radians(pitch)
        cosine = math.sin(p) * math.sin(at[1]) + math.cos(p) * math.cos(at[1]) * math.cos(a)
        close = {"abs": straight / 200}
        expected = straight * (1.0 + cosine) / 2.0
        assert receptor_reading(light, azimuth, pitch) == pytest.approx(expected, **close)
        flat = receptor_reading(light, azimuth, pitch, dome=False)
        assert flat == pytest.approx(straight * max(cosine, 0.0), **close)


def asset_of(name: str, content: bytes, kind: str = "sun") -> Asset:
    known = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    return Asset(name=name, kind=kind, split="test", **known)


@pytest.fixture
def an_asset(tmp_path, monkeypatch):
    """Makes an asset of a panorama, as the file that a folder of real files holds."""

    def make(light: np.ndarray) -> Asset:
        path = tmp_path / "hdri_pool" / "made.hdr"
        write_hdr(path, image=light.transpose(1, 2, 0))
        monkeypatch.setenv("AE_ENV_DATA", str(tmp_path))
        return asset_of("made", path.read_bytes(), "overcast")

    return make


def test_a_wall_of_an_even_world_is_exposed_alike_at_any_level(an_asset):
    even = panorama(lambda lon, lat: 3.0 + 0.0 * lat + 0.0 * lon)
    views = list(polyhaven.asset_views(an_asset(even), CAMERA, size=16, views=50))
    for scene in views:
        # E = 2 pi L asks for 100 E / 340; x = L / (1.2 * 2^EV100), as ISO 12232 has it.
        expected = 1.0 / (1.2 * 2.0 * math.pi * 100.0 / 340.0)
        assert scene.light[1:3].mean().item() == pytest.approx(expected, rel=0.01)
        assert (scene.sampled, scene.box_factor) == (True, 1)
    low, high = np.log(polyhaven.ILLUMINANCE["overcast"])
    # Of lux on a flat surface, pi L; a dome's 2 pi L count 250 / 340 of such lux each.
    lux = np.array([scene.illuminance for scene in views]) / (2.0 * 250.0 / 340.0)
    levels = (np.log(lux) - low) / (high - low)
    assert 0 <= levels.min() < levels.max() <= 1
    assert levels.mean() == pytest.approx(0.5, abs=0.15)  # log-uniform
    assert levels.std() == pytest.approx(12**-0.5, abs=0.08)
    gradient = panorama(lambda lon, lat: 2.0 + np.sin(lat) + 0.3 * np.cos(lon))
    assert polyhaven.cut_values(gradient) == []
    assert polyhaven.cut_values(np.minimum(gradient, 2.9)) == ["highlights are cut"]
    assert polyhaven.cut_values(np.maximum(gradient - 1.2, 0.0)) == ["shadows are cut"]
    asset = an_asset(np.minimum(gradient, 2.9))
    assert "highlights are cut" in next(polyhaven.asset_views(asset, CAMERA, size=16)).source


def test_a_view_towards_the_light_has_less_on_its_subject(an_asset, monkeypatch):
    """A bright half of the world: the view into it is lit from behind."""
    monkeypatch.setitem(polyhaven.ILLUMINANCE, "overcast", (1e4, 1e4))
    half = panorama(lambda lon, lat: np.where(np.abs(lon) < np.pi / 2, 1.0, 0.05) + 0.0 * lat)
    lux, seen = [], []
    for scene in polyhaven.asset_views(an_asset(half), CAMERA, size=16, views=16):
        lux.append(scene.illuminance)
        seen.append(scene.light[1].median().item())
    # A dome that faces the bright half reads 1.5 + 0.05 / 2, one that turns from it 0.5 + 0.075.
    assert max(lux) / min(lux) == pytest.approx(1.525 / 0.575, rel=0.1)
    darkest, brightest = np.argmin(lux), np.argmax(lux)
    assert seen[darkest] / seen[brightest] == pytest.approx(20 * 1.525 / 0.575, rel=0.1)


def test_real_scenes_alone_and_mixed(data_dir):
    request = SceneRequest("test", CAMERA, 36)
    # The second time from the cache.
    real, again = (polyhaven.polyhaven_scenes(request, views=1) for _ in range(2))
    assert len({s.group for s in real}) >= 15
    assert all(a.content == b.content for a, b in zip(real, again, strict=True))
    for scene in real:
        assert (scene.light.shape, scene.box_factor) == ((4, 36, 36), 7)
        assert 1e-3 < scene.illuminance <= 2.0 * polyhaven.ILLUMINANCE[scene.kind][1]
    check_oracles_are_spread(real)
    scenes = load_scenes(real, "validation", camera=CAMERA, resolution=36)  # as an evaluation does
    assert [s.scene_id for s in scenes] == [s.scene_id for s in real]
    with pytest.raises(ValueError, match="needs `scenes='polyhaven'`"):
        load_scenes("mixed", "validation", camera=CAMERA)
    drawn = [replace(real[0], scene_id=f"drawn-{i}", source="") for i in range(10)]
    mixed = polyhaven.mixed_scenes(request, drawn, polyhaven.split_assets("polyhaven", "test"))
    kinds = Counter(scene.source.startswith("Poly Haven") for scene in mixed)
    assert kinds[True] == kinds[False] == 10
    assert {s.group for s in mixed if s.source.startswith("Poly")} < {s.group for s in real}
    # Pans of moving light are of places to test on, and of their maps.
    places = read_pans()
    assert set(places) <= {asset.name for asset in list_assets() if asset.split == "test"}
    assert {len(turn) for turn in places.values()} == {72}
    asset = next(a for a in polyhaven.split_assets("polyhaven", "test") if a.name == "spree_bank")
    panorama, luminance = read_radiance(asset.path), np.float32([0.2126, 0.7152, 0.0722])
    turn = [perspective(panorama, azimuth, 48, 60.0, 0.0) for azimuth in np.arange(-180.0, 180, 5)]
    views = np.stack([np.tensordot(luminance, view, axes=1) for view in turn])
    white = 6.0 * np.exp(np.log(np.maximum(views, 1e-6)).mean())
    ev = np.log2(np.minimum(views, white).mean(axis=(1, 2)))
    np.testing.assert_allclose(places["spree_bank"], ev - ev[0], atol=6e-4)


CONTENT = {f"map_{i}": bytes([i]) * (5000 + i) for i in range(3)}


@pytest.fixture
def server(tmp_path, monkeypatch):
    """The address of a server of three maps, and its folder."""
    folder = tmp_path / "maps"
    folder.mkdir()
    for name, content in CONTENT.items():
        (folder / f"{name}_1k.hdr").write_bytes(content)
    handler = functools.partial(SimpleHTTPRequestHandler, directory=folder)
    running = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=running.serve_forever, daemon=True).start()
    assets = tuple(asset_of(name, content) for name, content in CONTENT.items())
    monkeypatch.setattr(polyhaven, "list_assets", lambda: assets)
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path))
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    yield f"http://127.0.0.1:{running.server_port}", folder
    running.shutdown()
    running.server_close()


def test_a_download_fetches_what_is_missing_and_nothing_broken(server, tmp_path, monkeypatch):
    (url, folder), total = server, sum(map(len, CONTENT.values()))
    seen: list[tuple[int, int, str]] = []
    assert len(polyhaven.download(url=url, progress=lambda *values: seen.append(values))) == 3
    maps = {name: tmp_path / "cache" / "polyhaven" / f"{name}_1k.hdr" for name in CONTENT}
    assert {name: path.read_bytes() for name, path in maps.items()} == CONTENT
    assert (seen[0], seen[-1][:2]) == ((0, total, "map_0"), (total, total))
    assert polyhaven.download(url=url, progress=None) == []
    maps["map_1"].write_bytes(bytes(len(CONTENT["map_1"])))  # of the right length
    assert polyhaven.download(url=url, progress=None) == [maps["map_1"]]
    assert maps["map_1"].read_bytes() == CONTENT["map_1"]
    maps["map_1"].unlink()
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    for content, reason in ((b"another file", "hash"), (bytes(5002), "may have 5001 bytes")):
        (folder / "map_1_1k.hdr").write_bytes(content)
        with pytest.raises(ConnectionError, match=f"map_1_1k.hdr cannot be fetched: .*{reason}"):
            polyhaven.download(url=url, progress=None)
        assert not maps["map_1"].exists()  # no part of a file either
    with pytest.raises(ValueError, match="`url`"):
        polyhaven.download(url="ftp://a", progress=None)
