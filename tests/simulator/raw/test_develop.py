"""Developing against LibRaw, colour-demosaicing, published matrix arithmetic and closed forms."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import rawpy
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from ae_env.scenes import Scene
from simulator import (
    CameraSettings,
    CameraSimulator,
    NoiseLevelFunction,
    RawImage,
    develop,
    read_raw,
    render_srgb,
)
from simulator.camera import BayerPattern, CameraProfile, get_camera
from simulator.raw.develop import (
    apply_tone,
    demosaic_malvar,
    develop_inverse,
    neutral_highlights,
    srgb_encode,
)
from tests.strategies import lights, log_uniform

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # its own imports warn about optional packages
    from colour_demosaicing import demosaicing_CFA_Bayer_Malvar2004

Z6 = get_camera("nikon_z6")


def flat(r: float, g: float, b: float, size: int = 4) -> torch.Tensor:
    return torch.tensor([r, g, g, b]).reshape(1, 4, 1, 1).repeat(1, 1, size, size)


def srgb(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, spelled out once more."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_tone_curve_shows_the_grey_card_as_grey_and_is_inverted():
    linear = torch.linspace(0, 1, 10_001, dtype=torch.float64)
    curve = apply_tone(linear, "photographic")
    assert (curve.diff() > 0).all()
    assert (curve.diff().diff() < 1e-12).all()  # concave: contrast falls towards the highlights
    known = apply_tone(torch.tensor([0, 0.18 * 0.6635, 1], dtype=torch.float64), "photographic")
    np.testing.assert_allclose(known, [0, 0.18, 1], atol=1e-12)
    encoded = srgb_encode(linear.float()).numpy()
    np.testing.assert_allclose(encoded, srgb(linear.numpy()), atol=5e-7)
    assert (np.diff(encoded) >= 0).all()
    # The inverse, above the sRGB curve's toe by hand: Schlick's curve solved for light.
    codes = torch.arange(256, dtype=torch.uint8).reshape(1, 1, 16, 16).expand(1, 3, 16, 16)
    light, same = develop_inverse(codes), develop_inverse(codes.float() / 255.0)
    assert torch.allclose(light, same, rtol=1e-5, atol=1e-8)
    shown, p = ((200 / 255 + 0.055) / 1.055) ** 2.4, 1.618
    by_hand = shown / (p - (p - 1) * shown)
    assert light[0, 3].flatten()[200].item() == pytest.approx(by_hand, rel=1e-3)
    assert develop(same).sub(codes / 255.0).abs().max() < 1e-5


def test_develop_follows_the_formula():
    """R, mean green, B -> gains -> matrix -> sRGB, computed with numpy for one colour."""
    out = develop(flat(0.1, 0.2, 0.15), (2.0, 1.0, 1.5), Z6.colour_matrix, tone="linear")
    # IEC 61966-2-1
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    camera_from_srgb = np.array(Z6.colour_matrix) @ to_xyz
    camera_from_srgb /= camera_from_srgb.sum(axis=1, keepdims=True)
    linear = np.linalg.solve(camera_from_srgb, [0.2, 0.2, 0.225])
    assert (out.shape, out.dtype) == ((1, 3, 4, 4), torch.float32)
    np.testing.assert_allclose(out[0, :, 0, 0].numpy(), srgb(linear), atol=1e-6)
    # Negative pixels survive up to the last clip: a half-size green averages them in.
    out = develop(torch.tensor([0.0, -0.02, 0.06, 0.0]).reshape(1, 4, 1, 1), tone="linear")
    assert out[0, 1].item() == pytest.approx(float(srgb(np.array(0.02))), abs=1e-6)


@pytest.mark.parametrize("gains", [(2.1, 1.0, 1.5), (0.8, 1.0, 2.9), (1.0, 1.7, 1.0)])
@pytest.mark.parametrize("level", [1.0, 1e6])
def test_saturated_areas_are_white(gains, level):
    out = develop(flat(level, level, level), gains, Z6.colour_matrix)
    np.testing.assert_allclose(out, 1.0, atol=1e-6)
    raw = RawImage(flat(level, level, level)[0], CameraSettings(100, 0.01, 4), Z6, None, gains)
    for demosaic in ("malvar", "half"):
        assert (render_srgb(raw, demosaic) == 255).all()
    dimmed = render_srgb(raw, exposure_ev=-2.0)
    assert (dimmed == dimmed[0, 0, 0]).all()  # grey, not magenta


@example(torch.zeros(4, 1, 1), (1e-30, 1.0, 1e30), "linear")  # gains further apart than float32
@given(
    lights(),
    st.tuples(*[log_uniform(1e-30, 1e30)] * 3),
    st.sampled_from(["linear", "photographic"]),
)
def test_any_light_is_developed_within_the_range(light, white_balance, tone):
    rgb = develop(light[None], white_balance, Z6.colour_matrix, tone=tone)
    assert bool(((rgb >= 0) & (rgb <= 1)).all())
    twice = develop(torch.stack([light.flip(2), light]), white_balance, Z6.colour_matrix, tone=tone)
    torch.testing.assert_close(twice[1], rgb[0], rtol=0, atol=1e-6)
    torch.testing.assert_close(twice[0].flip(2), rgb[0], rtol=0, atol=1e-6)
    raw = RawImage(light, CameraSettings(100, 0.01, 4), Z6, white_balance=white_balance)
    for exposure_ev in (-32, 0, 32):
        shown = render_srgb(raw, exposure_ev=exposure_ev, tone=tone)
        assert shown.shape == (3, 2 * light.shape[1], 2 * light.shape[2])


@pytest.mark.parametrize("size", [(1, 5), (2, 2), (3, 7)])
def test_render_sizes(size):
    camera = CameraProfile("c", "GBRG", 0, 1023, 10)
    raw = RawImage(torch.full((4, *size), 0.5), CameraSettings(100, 0.01, 4), camera)
    full, half = render_srgb(raw), render_srgb(raw, "half")
    assert (full.shape, half.shape) == ((3, 2 * size[0], 2 * size[1]), (3, *size))
    assert full.dtype == half.dtype == torch.uint8
    # Schlick: 1.618 * .5 / (.618 * .5 + 1) = .618; sRGB .8077; 206
    assert set(full.unique().tolist()) == set(half.unique().tolist()) == {206}
    darker = render_srgb(raw, "half", exposure_ev=-1.0, tone="linear")
    assert darker.unique().tolist() == [round(255 * float(srgb(np.array(0.25))))]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("demosaic", "malvr"), ("tone", "aces"), ("exposure_ev", math.nan)],
        *[("images", torch.zeros(4, 8, 8)), ("white_balance", (1.0, math.nan, 1.0))],
        *[("colour_matrix", torch.ones(3, 3)), ("colour_matrix", -torch.eye(3))],
    ],
)
def test_bad_arguments(name, value):
    raw = RawImage(torch.zeros(4, 2, 2), CameraSettings(100, 0.01, 4), Z6)
    shown = name in ("demosaic", "tone", "exposure_ev")
    call, usual = (render_srgb, {"raw": raw}) if shown else (develop, {"images": raw.data[None]})
    with pytest.raises(ValueError, match=f"`{name}`"):
        call(**(usual | {name: value}))


@pytest.mark.real_data
def test_a_real_raw_looks_as_libraw_shows_it(data_dir):
    path = data_dir / "canon_crw_cc0" / "CRW_0101.CRW"
    as_ours = {"half_size": True, "use_camera_wb": True, "user_flip": 0, "gamma": (2.4, 12.92)}
    plain = {"no_auto_bright": True, "adjust_maximum_thr": 0.0, "output_bps": 16}
    with rawpy.imread(str(path)) as file:
        theirs = file.postprocess(**as_ours, **plain, bright=4.0)
    raw = read_raw(path)
    ours = render_srgb(raw, "half", 2.0, tone="linear").permute(1, 2, 0).numpy()
    assert ours.shape == theirs.shape
    difference = ours - theirs / 257.0
    assert np.abs(difference.mean(axis=(0, 1))).max() < 0.25
    assert np.quantile(np.abs(difference), 0.999) < 1.5


PATTERNS = [p.value for p in BayerPattern]


def pack(mosaic: np.ndarray, pattern: str) -> torch.Tensor:
    """(2H, 2W) float mosaic to (1, 4, H, W), by the letters of the pattern alone."""
    red, blue = pattern.index("R"), pattern.index("B")
    tiles = [mosaic[i // 2 :: 2, i % 2 :: 2] for i in (red, red ^ 1, blue ^ 1, blue)]
    return torch.from_numpy(np.stack(tiles))[None]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 5e-7)])
@pytest.mark.parametrize("size", [(4, 4), (4, 10), (6, 4), (22, 34)])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_malvar_equals_colour_demosaicing_of_a_mirrored_mosaic(pattern, size, dtype, tolerance):
    mosaic = np.random.default_rng(1).random(size)
    packed = pack(mosaic, pattern).to(dtype)
    ours = demosaic_malvar(packed, pattern)
    assert ours.dtype == dtype
    batch = demosaic_malvar(torch.cat([packed.flip(3), packed]), pattern)
    assert torch.equal(batch[1:], ours)  # each image by itself
    mirrored = np.pad(mosaic, 4, mode="reflect")
    theirs = demosaicing_CFA_Bayer_Malvar2004(mirrored, pattern)[4:-4, 4:-4]
    np.testing.assert_allclose(ours[0].permute(1, 2, 0), theirs, rtol=0, atol=tolerance)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_malvar_on_the_gpu_is_not_rounded():
    packed = torch.rand(2, 4, 9, 8)
    on_gpu = demosaic_malvar(packed.cuda(), "GBRG").cpu()
    torch.testing.assert_close(on_gpu, demosaic_malvar(packed, "GBRG"), atol=3e-7, rtol=0)


BASE = CameraSettings(100, 1 / 64, 4)
#: Levels of white: dark, only green clips, blue too, all planes; and a red lamp.
WHITE = (0.5, 1.1, 1.6, 9.0)
BALANCE = (2.0, 1.0, 1.25)


def clipped(*pixels: tuple[float, ...], balance: tuple[float, float, float] = BALANCE) -> RawImage:
    """Light (R, G, B) of pixels, as a sensor clips it."""
    light = np.array(pixels, np.float32)[:, [0, 1, 1, 2]].T[:, None]
    return RawImage(np.minimum(light, 1.0), BASE, Z6, white_balance=balance)


@pytest.mark.parametrize(
    ("recorded", "expected"),
    [  # a white of level L is L / 2, L, L / 1.25 by BALANCE; L is known while red is not clipped
        *(((v / 2, v, v / 1.25), (v / 2, v, v / 1.25)) for v in WHITE[:3]),
        ((4.5, 9.0, 7.2), (2.0, 4.0, 3.2)),  # twice as bright as red's white
        ((3.0, 0.3, 0.2), (1.0, 0.3, 0.2)),  # a red lamp stays red
        ((0.9, 1.0, 0.2), (0.9, 1.025, 0.2)),  # levels 1.8 and 0.25 are known
    ],
)
def test_clipped_planes_become_as_bright_as_white(recorded, expected) -> None:
    raw = clipped(recorded)
    light = neutral_highlights(raw, raw.saturated)
    np.testing.assert_allclose(light[[0, 1, 3], 0, 0], expected, rtol=1e-6)
    assert light[2].equal(light[1])


@pytest.mark.parametrize("light", [0.92, 0.97, 1.0, 1.02])
def test_what_noise_alone_clips_stays_near_white(light: float) -> None:
    """A flat patch at ISO 6400: nothing measured is replaced, and the rest is off by the noise."""
    deviation = 0.03
    nlf = NoiseLevelFunction((deviation**2,) * 4, (0.0,) * 4)
    noise = deviation * torch.randn(4, 48, 48, generator=torch.Generator().manual_seed(0))
    recorded = (light + noise).clamp(max=1.0)
    raw = RawImage(recorded, BASE, Z6, nlf, white_balance=(2.0, 1.0, 1.5))
    found = neutral_highlights(raw, raw.saturated)
    measured = recorded < 1.0 - 1e-4
    assert found[measured].equal(recorded[measured])
    assert (found >= recorded).all()
    inner = found[:, 3:-3, 3:-3]
    assert (inner - light).square().mean().sqrt() < 1.1 * deviation


def test_a_full_photosite_below_white_and_an_absurd_balance() -> None:
    """Some compact cameras' photosites are full below white; of others such a value is measured."""
    raw = clipped((1.0, 1.0, 1.0))
    raw.data[1] = 0.94  # a smaller full well than the other green's
    found = neutral_highlights(raw, raw.saturated)[:, 0, 0].tolist()
    assert found == pytest.approx([1.0, 0.94, 1.0, 1.0])  # the level 0.94 is below white
    raw = replace(raw, camera=replace(Z6, full_level=0.92))
    assert neutral_highlights(raw, raw.saturated)[:, 0, 0].tolist() == pytest.approx([2, 4, 4, 3.2])
    raw = clipped((1.0, 1.0, 1.0), balance=(1e30, 1.0, 1.0))
    assert neutral_highlights(raw, raw.saturated).max() == 16.0


@pytest.mark.parametrize("ratio", [1 / 16, 4.0])
def test_captures_and_scenes_show_neutral_highlights(ratio: float) -> None:
    pixels = [(v / 2, v, v / 1.25) for v in WHITE]
    raw, settings = clipped(*pixels), CameraSettings(100, ratio / 64, 4)
    prepared = CameraSimulator(device="cpu").prepare(raw)
    # A quarter of all pixels is wholly clipped: 1.2 + 0.8 / 4 times red's white, which is 2.
    level = torch.tensor([0.5, 1.1, 1.6, 2.8]) * ratio
    expected = level / torch.tensor([2, 1, 1, 1.25])[:, None]
    scene = Scene.from_raw(raw, scene_id="raw")
    assert (scene.illuminance, scene.reference) == (None, raw.settings)
    for found in (prepared, scene.prepared):
        light = found.expected(settings)[:, 0]
        torch.testing.assert_close(light, expected)
        if ratio >= 1.0:  # as bright as the clipped raw would be
            as_clipped = (raw.data[:, 0] * ratio).clamp(max=1.0)
            assert (light.clamp(max=1.0) - as_clipped).abs().max() < 1e-6
        assert found.saturated is not None
        assert found.saturated.tolist() == [[False, True, True, True]]
    black = RawImage(torch.cat([raw.data, torch.zeros(4, 3, 4)], 1), BASE, Z6, None, BALANCE)
    small = Scene.from_raw(black, scene_id="raw").resized(1).light.flatten()
    expected[:, 3] *= 2.5 / 2.8  # now a 16th
    torch.testing.assert_close(small, expected.mean(1) / ratio / 4)  # averaged after, not before
    dark = clipped(pixels[0])
    assert Scene.from_raw(dark, scene_id="raw").saturated is None
    assert CameraSimulator(device="cpu").prepare(dark).light is dark.data
