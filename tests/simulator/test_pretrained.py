"""The weights that come with the package do what the model card and the documentation say."""

import json
import math
from importlib import resources
from pathlib import Path

import pytest
import torch

from ae_env.scenes.reference_scenes import reference_scenes
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera
from simulator.optics.disc_bank import added_blur
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene

FOLDER = Path(str(resources.files("simulator").joinpath("pretrained")))


@pytest.fixture(scope="module")
def simulator() -> CameraSimulator:
    return CameraSimulator.from_pretrained("compact", device="cpu")


def right_exposure(scene: ReferenceScene, iso: float, f_number: float) -> CameraSettings:
    """What an incident-light meter says: log2(N^2 / t) - log2(ISO / 100) = log2(E / 2.5)."""
    assert scene.illuminance is not None
    unit = CameraSettings(iso, 1.0, f_number)
    return CameraSettings(iso, 2.0 ** (-unit.log2_exposure) * 2.5 / scene.illuminance, f_number)


def gain_db(simulator: CameraSimulator, scene: ReferenceScene, camera_name: str) -> float:
    """Error of exposing only over error after denoising, ISO 6400 to ISO 100, unclipped pixels."""
    camera = get_camera(camera_name)
    body = ReferenceCamera(camera)
    source = right_exposure(scene, 6400, 8)
    target = CameraSettings(100, source.exposure_time * 64, 8)
    capture = body.capture(scene, source, seed=1)
    truth = body.capture(scene, target, seed=2).mean
    prepared = simulator.prepare(RawImage(capture.sample, source, camera))
    used = (truth < 0.99) & (capture.sample < 0.99)
    before = (capture.sample - truth)[used].square().mean()
    after = (prepared.expected(target) - truth)[used].square().mean()
    return 10.0 * math.log10(float(before / after))


def test_card_says_how_the_weights_were_made() -> None:
    assert sum(f.stat().st_size for f in FOLDER.iterdir()) <= 4e6
    card = json.loads((FOLDER / "compact.json").read_text(encoding="utf-8"))
    for entry in ("training", "scenes", "stages", "command", "commit", "date", "sha256"):
        assert card[entry], entry
    assert set(card["stages"]) == {"exposure", "noise", "aperture"}


@pytest.mark.parametrize(
    ("camera", "kind", "least"),
    [
        ("nikon_z6", "procedural", 3.0),  # a network that does nothing, or blurs, has less
        ("canon_70d", "procedural", 3.0),
        pytest.param("nikon_z6", "radiance", 4.0, marks=pytest.mark.real_data),
        pytest.param("canon_70d", "radiance", 5.0, marks=pytest.mark.real_data),
    ],
)
def test_denoising(
    simulator: CameraSimulator, camera: str, kind: str, least: float, request: pytest.FixtureRequest
) -> None:
    if kind == "radiance":
        data = request.getfixturevalue("data_dir")
        scenes = reference_scenes("test", get_camera(camera), number=0, size=128, radiance=data)
        scenes = [scene for scene in scenes if scene.kind == "radiance"]
    else:
        scenes = reference_scenes("test", get_camera(camera), number=6, size=96)[:6]
    gains = [gain_db(simulator, scene, camera) for scene in scenes]
    assert sum(gains) / len(gains) > least
    assert min(gains) > 0.0 or kind == "radiance"


def test_opening_blurs_what_is_out_of_focus_and_only_that(simulator: CameraSimulator) -> None:
    """Half of the error of exposing alone where the circle of confusion is 3 pixels or more."""
    camera = get_camera("nikon_z6")
    body = ReferenceCamera(camera)
    scenes = [s for s in reference_scenes("test", camera, number=10, size=128) if s.kind == "depth"]
    errors = {"before": 0.0, "after": 0.0}
    for scene in scenes:
        source = right_exposure(scene, 100, 11)
        target = CameraSettings(100, source.exposure_time / 8, 4)
        raw = RawImage(body.capture(scene, source, seed=1).sample, source, camera)
        truth = body.capture(scene, target, seed=2).mean
        opened = simulator.prepare(raw, depth="unknown").expected(target)
        blurred = body.blur_diameter(scene, 11) >= 3.0
        inner = torch.zeros_like(blurred)
        inner[11:-11, 11:-11] = True
        used = blurred & inner & (truth < 0.5).all(0) & (raw.data < 0.5).all(0)
        errors["before"] += float((raw.data - truth)[:, used].square().sum())
        errors["after"] += float((opened - truth)[:, used].square().sum())
    assert math.sqrt(errors["after"] / errors["before"]) < 0.5


def test_a_sharp_picture_stays_sharp(simulator: CameraSimulator) -> None:
    """White noise of contrast 20 % has all of its detail at one pixel: nothing is defocused."""
    generator = torch.Generator().manual_seed(0)
    data = 0.2 + 0.04 * torch.randn(4, 64, 64, generator=generator)
    raw = RawImage(data, CameraSettings(100, 1 / 64, 11), get_camera("nikon_z6"))
    prepared = simulator.prepare(raw, depth="unknown")
    diameter = simulator.estimate_defocus(prepared)
    assert float(added_blur(diameter, 11.0, 4.0).median()) == 0.0
