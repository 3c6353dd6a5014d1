"""Poly Haven's panoramas: the list, light of the map itself, downloads from a server near by."""

import hashlib
import math
import threading
import time
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from ae_env.lighting.moving import read_pans
from ae_env.scenes import polyhaven
from ae_env.scenes.bundled import bundled_scenes
from ae_env.scenes.load import load_scenes
from ae_env.scenes.polyhaven import (
    ILLUMINANCE,
    Asset,
    asset_views,
    cut_values,
    download,
    incident_light,
    light_around,
    list_assets,
    mixed_scenes,
    polyhaven_scenes,
    split_assets,
)
from ae_env.scenes.scene import SceneRequest
from simulator import get_camera
from simulator.radiance.light import WHITE_SIGNAL
from simulator.radiance.maps import read_radiance

CAMERA = get_camera("nikon_z6")


def test_the_list_splits_places_and_each_kind_is_tested():
    splits = {}
    for asset in list_assets():
        assert splits.setdefault(asset.place, asset.split) == asset.split
    assert len({a.name for a in list_assets()}) == len(list_assets()) >= 40
    tested = {a.kind for a in list_assets() if a.split == "test"}
    assert tested >= {"night", "indoor", "backlit", "forest", "sun", "overcast", "studio", "tunnel"}
    assert list(splits.values()).count("test") >= 15  # enough for intervals


def panorama(light) -> np.ndarray:
    """(3, 256, 512) grey light as a function of longitude and latitude [radians]."""
    longitude = (np.arange(512) + 0.5) / 512 * 2 * np.pi - np.pi
    latitude = np.pi / 2 - (np.arange(256) + 0.5) / 256 * np.pi
    grey = np.broadcast_to(light(longitude[None, :], latitude[:, None]), (256, 512))
    return np.repeat(grey[None], 3, axis=0).astype(np.float32)


def test_an_even_sky_gives_pi_times_its_luminance_and_a_dome_half_of_it_to_a_wall():
    even = panorama(lambda lon, lat: 2.0 + 0.0 * lat + 0.0 * lon)
    for azimuth, pitch in ((0, 90), (17, 0), (-120, 35), (0, -90)):
        assert incident_light(even, azimuth, pitch) == pytest.approx(2.0 * math.pi, rel=1e-4)
    dome = panorama(lambda lon, lat: (lat > 0) + 0.0 * lon)
    assert incident_light(dome, 0, 90) == pytest.approx(math.pi, rel=1e-3)
    for azimuth in (0, 45, 180):
        assert incident_light(dome, azimuth, 0) == pytest.approx(math.pi / 2, rel=1e-3)
    assert incident_light(dome, 0, -90) == pytest.approx(0, abs=1e-6)


def test_a_small_lamp_lights_a_surface_by_the_cosine():
    at = math.radians(40), math.radians(20)

    def lamp(longitude, latitude):
        near = (abs(longitude - at[0]) < 0.03) & (abs(latitude - at[1]) < 0.03)
        return 500.0 * near

    light = panorama(lamp)
    straight = incident_light(light, 40, 20)
    for azimuth, pitch in ((40, 80), (70, 20), (40, -30), (-140, -20)):
        a, p = math.radians(azimuth) - at[0], math.radians(pitch)
        cosine = math.sin(p) * math.sin(at[1]) + math.cos(p) * math.cos(at[1]) * math.cos(a)
        expected = straight * max(cosine, 0.0)
        assert incident_light(light, azimuth, pitch) == pytest.approx(expected, abs=straight / 200)


@pytest.fixture
def an_asset(tmp_path, monkeypatch):
    """Makes an asset of a panorama, as the file that a folder of real files holds."""

    def make(light: np.ndarray, kind: str = "overcast") -> Asset:
        import cv2

        path = tmp_path / "hdri_pool" / "made.hdr"
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), light.transpose(1, 2, 0)[:, :, ::-1])
        monkeypatch.setenv("AE_ENV_DATA", str(tmp_path))
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        return Asset(name="made", kind=kind, split="test", bytes=len(content), sha256=digest)

    return make


def test_a_white_wall_under_an_even_sky_is_white_at_any_level(an_asset):
    """A view of it is as bright as a white surface that it lights; each view has its own level."""
    even = panorama(lambda lon, lat: 3.0 + 0.0 * lat + 0.0 * lon)
    views = list(asset_views(an_asset(even), CAMERA, size=16, views=50))
    for scene in views:
        assert scene.light[1:3].mean().item() == pytest.approx(WHITE_SIGNAL, rel=0.01)
        assert (scene.sampled, scene.box_factor) == (True, 1)
    low, high = np.log(ILLUMINANCE["overcast"])
    levels = (np.log([scene.illuminance for scene in views]) - low) / (high - low)
    assert 0 <= levels.min() < levels.max() <= 1
    assert levels.mean() == pytest.approx(0.5, abs=0.15)  # log-uniform
    assert levels.std() == pytest.approx(12**-0.5, abs=0.08)


def test_a_view_towards_the_light_has_less_on_its_subject(an_asset, monkeypatch):
    """A bright half of the world: the view into it is lit from behind."""
    monkeypatch.setitem(ILLUMINANCE, "overcast", (1e4, 1e4))
    half = panorama(lambda lon, lat: np.where(np.abs(lon) < np.pi / 2, 1.0, 0.05) + 0.0 * lat)
    lux, seen = [], []
    for scene in asset_views(an_asset(half), CAMERA, size=16, views=16):
        lux.append(scene.illuminance)
        seen.append(scene.light[1].median().item())
    order = np.argsort(lux)
    assert lux[order[-1]] / lux[order[0]] == pytest.approx(20, rel=0.3)
    assert seen[order[0]] > 100 * seen[order[-1]]  # 20 in the light, 20 in the exposure


def test_maps_that_are_cut_say_so(an_asset):
    gradient = panorama(lambda lon, lat: 2.0 + np.sin(lat) + 0.3 * np.cos(lon))
    assert cut_values(gradient) == []
    assert cut_values(np.minimum(gradient, 2.9)) == ["highlights are cut"]
    assert cut_values(np.maximum(gradient - 1.2, 0.0)) == ["shadows are cut"]
    asset = an_asset(np.minimum(gradient, 2.9))
    assert "highlights are cut" in next(asset_views(asset, CAMERA, size=16)).source


def test_real_scenes_alone_and_mixed(data_dir):
    request = SceneRequest("test", CAMERA, 36)
    real, again = (polyhaven_scenes(request, views=1) for _ in range(2))  # then from the cache
    assert len({s.group for s in real}) >= 15
    assert all(a.content == b.content for a, b in zip(real, again, strict=True))
    for scene in real:
        assert (scene.light.shape, scene.box_factor) == ((4, 36, 36), 7)
        assert 1e-3 < scene.illuminance <= ILLUMINANCE[scene.kind][1] * (1 + 1e-6)
    mixed = mixed_scenes(request, list(bundled_scenes(request, part="snow")), len(real))
    kinds = Counter(scene.source.startswith("Poly Haven") for scene in mixed)
    assert kinds[True] == kinds[False] == 10
    assert {s.group for s in mixed if s.source.startswith("Poly")} < {s.group for s in real}
    # Pans of moving light are of places to test on, and of their maps.
    places = read_pans()
    assert set(places) == {asset.name for asset in list_assets() if asset.split == "test"}
    assert {len(turn) for turn in places.values()} == {72}
    asset = next(a for a in split_assets("polyhaven", "test") if a.name == "spree_bank")
    found = light_around(read_radiance(asset.path))
    np.testing.assert_allclose(places["spree_bank"], found, atol=6e-4)


def test_missing_maps_name_the_command(tmp_path, monkeypatch):
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path))
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "none"))
    with pytest.raises(FileNotFoundError, match=r"19 of 19 maps .*ae-env scenes download"):
        load_scenes("polyhaven", "test", camera=CAMERA)
    with pytest.raises(FileNotFoundError, match=r"'mixed'\): 21 of 21 maps"):
        load_scenes("mixed", "train", camera=CAMERA)


CONTENT = {f"map_{i}": bytes([i]) * (5000 + i) for i in range(3)}


@pytest.fixture
def server(tmp_path, monkeypatch):
    """A server of three maps; `faults` names what is wrong with the next answers of each."""
    faults: dict[str, list[str]] = {}
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            name = self.path.split("/")[-1].removesuffix("_1k.hdr")
            asked.append(name)
            content = CONTENT[name]
            fault = faults.get(name, []).pop(0) if faults.get(name) else ""
            if fault == "error":
                self.send_error(503)
                return
            if fault == "slow":
                time.sleep(1.5)
            if fault == "other":
                content = content[::-1] + b"x"
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content[:100] if fault == "truncated" else content)

        def log_message(self, *_: object) -> None:
            pass

    running = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=running.serve_forever, daemon=True).start()
    known = {"kind": "sun", "split": "test"}
    assets = tuple(
        Asset(name=name, bytes=len(c), sha256=hashlib.sha256(c).hexdigest(), **known)
        for name, c in CONTENT.items()
    )
    monkeypatch.setattr(polyhaven, "list_assets", lambda: assets)
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path))
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    yield f"http://127.0.0.1:{running.server_port}/maps", faults, asked
    running.shutdown()
    running.server_close()


def stored(tmp_path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in (tmp_path / "cache" / "polyhaven").iterdir()}


def test_a_download_fetches_what_is_missing(server, tmp_path):
    url, _, asked = server
    seen: list[tuple[int, int, str]] = []
    assert len(download(url=url, progress=lambda *values: seen.append(values))) == 3
    assert stored(tmp_path) == {f"{name}_1k.hdr": content for name, content in CONTENT.items()}
    total = sum(map(len, CONTENT.values()))
    assert seen[0] == (0, total, "map_0")
    assert seen[-1][:2] == (total, total)
    assert download(url=url, progress=None) == []
    (damaged,) = tmp_path.rglob("map_1_1k.hdr")
    damaged.write_bytes(bytes(len(CONTENT["map_1"])))  # of the right length
    assert download(url=url, progress=None) == [damaged]
    assert asked[3:] == ["map_1"]
    assert stored(tmp_path) == {f"{name}_1k.hdr": content for name, content in CONTENT.items()}
    with pytest.raises(ValueError, match="`url`"):
        download(url="ftp://a", progress=None)


@pytest.mark.parametrize("fault", ["error", "truncated", "other", "slow"])
def test_a_broken_answer_is_asked_for_again_and_what_stays_broken_is_said(
    server, tmp_path, monkeypatch, fault
):
    url, faults, asked = server
    if fault != "slow":
        monkeypatch.setattr("time.sleep", lambda seconds: None)
        faults["map_1"] = [fault] * 3
        with pytest.raises(
            ConnectionError, match=r"map_1_1k.hdr cannot be fetched: .*what is there"
        ):
            download(url=url, progress=None)
        assert set(stored(tmp_path)) == {"map_0_1k.hdr"}  # no half of a file either
        asked.clear()
    faults["map_1"] = [fault]
    download(url=url, timeout=0.5, progress=None)
    assert asked[-3:] == ["map_1", "map_1", "map_2"]
    assert stored(tmp_path)["map_1_1k.hdr"] == CONTENT["map_1"]
