"""Packed raws, DNG files that come back, blind estimates of noise that was put in; developing."""

import itertools
import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import rawpy
import skimage.data
import tifffile
import torch
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from ae_env.scenes import Scene
from simulator import CameraSettings, CameraSimulator, NoiseLevelFunction, RawImage, estimate_nlf
from simulator.camera import BayerPattern, CameraProfile, get_camera, list_cameras
from simulator.raw import develop as developing
from simulator.raw.develop import develop, develop_inverse, neutral_highlights, render_srgb
from simulator.raw.dng import DEFAULT_COLOUR_MATRIX, write_dng
from simulator.raw.image import pack_mosaic, unpack_mosaic
from simulator.raw.read import read_raw
from tests.strategies import cameras, lights, log_uniform, mosaics, settings_within

SETTINGS = CameraSettings(100, 1 / 64, 4.0)
BLACK = (64.0, 60.25, 59.5, 63.0)  # R, G1, G2, B


def camera(cfa: str = "RGGB", black: tuple[float, ...] | float = BLACK) -> CameraProfile:
    return CameraProfile("bench", cfa, black, 4095, 12)


@given(mosaics(cameras()), st.booleans(), st.booleans())
def test_packing_and_unpacking_invert(mosaic, odd, as_float):
    profile, numbers = mosaic
    given_numbers = np.pad(numbers, ((0, odd), (0, odd))).astype(float if as_float else np.uint16)
    packed = pack_mosaic(given_numbers, profile)
    assert packed.shape == (4, numbers.shape[0] // 2, numbers.shape[1] // 2)
    np.testing.assert_array_equal(unpack_mosaic(packed, profile), numbers)
    raw = RawImage.from_mosaic(given_numbers, SETTINGS, profile)
    np.testing.assert_array_equal(raw.to_mosaic(), numbers)
    first = len(numbers) // 4  # a part of the rows
    np.testing.assert_array_equal(unpack_mosaic(packed, profile, first), numbers[2 * first :])
    for plane, letter in enumerate("RGGB"):  # each plane is where the camera says
        row, column = profile.cfa.offsets[plane]
        assert profile.cfa.value[2 * row + column] == letter
        wanted = (numbers[row::2, column::2] - profile.black_level[plane]) / profile.span[plane]
        np.testing.assert_array_equal(packed[plane].numpy(), wanted.astype(np.float32))


def test_unpack_clips_to_the_sensor_and_rounds():
    data = torch.tensor([-9.0, 9.0, 0.4 / 4031, 0.6 / 4031]).reshape(4, 1, 1)
    numbers = unpack_mosaic(data, camera(black=64))
    assert numbers.tolist() == [[0, 4095], [64, 65]]
    for shape in ((4,), (1, 8), (2, 2, 2)):
        with pytest.raises(ValueError, match="`mosaic`"):
            pack_mosaic(np.zeros(shape, np.uint16), camera())
    usual = {"data": torch.zeros(4, 2, 2).double(), "settings": SETTINGS, "camera": camera()}
    assert RawImage(**usual).data.dtype == torch.float32
    bad = {"camera": ["nikon_z6"], "settings": [(100, 0.01)], "nlf": [(1e-4, 1e-6)]}
    bad |= {"box_factor": [0, 1.5], "white_balance": [(1.0, 1.0), (1.0, 0.0, 1.0)]}
    beyond_float32 = torch.full((4, 2, 2), 1e300, dtype=torch.float64)
    bad["data"] = [*map(torch.zeros, [(3, 4, 4), (4, 4), (4, 0, 4)]), beyond_float32]
    for name, value in ((name, value) for name, values in bad.items() for value in values):
        with pytest.raises(ValueError, match=f"`{name}`"):
            RawImage(**(usual | {name: value}))


@pytest.mark.parametrize("rows", [1, 127, 300])
def test_saturated_pixels_of_frames_in_shares(rows):
    """Each plane has a limit of its own; NumPy marks the same pixels."""
    limits = [1 - 0.5 / (4095 - black) for black in BLACK]
    levels = np.random.default_rng(6).uniform(0.9995, 1.0001, (4, 9, rows)).astype(np.float32)
    data = levels.transpose(0, 2, 1)  # not in the order of memory
    expected = np.any(data >= np.array(limits, np.float32)[:, None, None], axis=0)
    assert 0 < expected.mean() < 1
    raw = RawImage(torch.from_numpy(data), SETTINGS, camera())
    np.testing.assert_array_equal(raw.saturated, expected)


NLF = NoiseLevelFunction((1.5e-4, 2e-4, 2e-4, 2.5e-4), (1e-6, 2e-6, 2e-6, 3e-6))


def make_raw(camera=None, **changes):
    profile = camera or CameraProfile("bench_camera", BayerPattern.RGGB, (512.0,) * 4, 15000, 14)
    options = {"nlf": NLF, "white_balance": (2.1, 1.0, 1.6), **changes}
    settings = options.pop("settings", CameraSettings(iso=800, exposure_time=1 / 60, f_number=4.0))
    numbers = np.random.default_rng(3).integers(0, 15001, (40, 56))
    return RawImage.from_mosaic(numbers, settings, profile, **options)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.dng"


@st.composite
def bodies(draw: st.DrawFn) -> CameraProfile:
    """Any body, or a real one with any order of its colours."""
    body = draw(cameras())
    name = draw(st.sampled_from([None, *list_cameras()]))
    return body if name is None else replace(get_camera(name), cfa=body.cfa)


@given(
    mosaics(bodies()),
    st.one_of(settings_within(), settings_within(iso=(1e-3, 0.5))),  # EXIF says ISO 1 at least
    st.tuples(log_uniform(1 / 64, 64), st.just(1.0), log_uniform(1 / 64, 64)),
    st.integers(1, 16),
)
def test_writing_and_reading_invert(tmp_path, mosaic, settings, white_balance, box_factor):
    (camera, numbers), target = mosaic, tmp_path / "a.dng"
    nlf = camera.nlf(settings.iso)
    assume(max(*nlf.shot, *nlf.read) <= 1.0)  # more is taken for damage
    known = {"white_balance": white_balance, "box_factor": box_factor}
    raw = RawImage.from_mosaic(numbers, settings, camera, **known)
    write_dng(target, raw)
    back = read_raw(target)
    np.testing.assert_array_equal(back.to_mosaic(), numbers)
    assert torch.equal(back.data, raw.data)
    assert (back.settings, back.box_factor) == (settings, box_factor)
    for name in ("cfa", "black_level", "white_level"):
        assert getattr(back.camera, name) == getattr(camera, name)
    assert back.white_balance == pytest.approx(white_balance, rel=1e-6)
    for name in ("shot", "read"):
        red, first, second, blue = getattr(raw.noise, name)
        green = (first + second) / 2  # a file has one pair for both
        assert getattr(back.noise, name) == pytest.approx((red, green, green, blue), rel=1e-12)


def test_noise_beyond_the_range_colour_matrix_and_camera_survive(path):
    nlf = NoiseLevelFunction((3.0, 4.0, 4.0, 5.0), (30.0, 40.0, 40.0, 50.0))
    write_dng(path, make_raw(nlf=nlf, settings=CameraSettings(409_600, 4.0, 1.0)))
    back = read_raw(path)
    assert (back.noise.shot, back.noise.read) == (nlf.shot, nlf.read)
    write_dng(path, make_raw(nlf=None))
    with tifffile.TiffFile(path) as tiff:  # nothing is known of its noise
        assert "NoiseProfile" not in tiff.pages.first.tags
    matrix = ((1.0, -0.25, 0.0), (-0.5, 1.5, 0.125), (0.0, -0.25, 0.75))
    z6 = replace(get_camera("nikon_z6"), colour_matrix=matrix, colour_matrix_source="measured")
    write_dng(path, make_raw(z6, nlf=None))
    back = read_raw(path)
    assert (back.camera.name, back.camera.colour_matrix_source) == ("nikon_z6", "measured")
    assert back.camera.colour_matrix == matrix  # not LibRaw's own for this camera
    assert back.camera.nlf(100) == z6.nlf(100)


def test_tags_as_tifffile_reads_them(path):
    known = {"datetime": "2024-02-03T04:05:06", "flip": 6}
    raw = make_raw(metadata=known)
    other_order = raw.data.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    write_dng(path, replace(raw, data=other_order))
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages.first
        tags = {tag.name: tag.value for tag in page.tags}
        assert len(page.dataoffsets) == 1
    expected = {"Compression": 1, "PhotometricInterpretation": 32803, "Orientation": 6}
    expected |= {"DateTime": "2024:02:03 04:05:06", "CFAPattern": b"\0\1\1\2"}
    expected |= {"DNGVersion": b"\1\4\0\0", "DNGBackwardVersion": b"\1\1\0\0"}
    expected |= {"BlackLevel": 512, "WhiteLevel": 15000, "CalibrationIlluminant1": 21}
    expected |= {"NoiseProfile": (1.5e-4, 1e-6, 2e-4, 2e-6, 2.5e-4, 3e-6)}
    assert {name: tags[name] for name in expected} == expected
    matrix = np.array(tags["ColorMatrix1"], float).reshape(3, 3, 2)
    np.testing.assert_allclose(matrix[..., 0] / matrix[..., 1], DEFAULT_COLOUR_MATRIX, rtol=1e-9)
    neutral = np.array(tags["AsShotNeutral"], float).reshape(3, 2)
    np.testing.assert_allclose(neutral[:, 0] / neutral[:, 1], [1 / 2.1, 1, 1 / 1.6], rtol=1e-9)
    exif = tags["ExifTag"]
    assert (exif["ExposureTime"], exif["FNumber"]) == ((1, 60), (4, 1))
    assert exif["ISOSpeedRatings"] == exif["RecommendedExposureIndex"] == 800
    back = read_raw(path)
    assert known.items() <= back.metadata.items()
    assert back.camera.colour_matrix is None  # the file's is the neutral default
    with rawpy.imread(str(path)) as libraw:
        np.testing.assert_array_equal(libraw.raw_image_visible, raw.to_mosaic())
    content = path.read_bytes().replace(*(np.array([1, n], "<u4").tobytes() for n in (60, 30)))
    path.write_bytes(content)  # what another program edits wins
    assert read_raw(path).settings.exposure_time == pytest.approx(1 / 30)


LEVELS = (0.02, 0.1, 0.18, 0.5)


def ramp() -> np.ndarray:
    course = np.linspace(0.0, 1.0, 384) ** 2
    return np.stack([np.broadcast_to(0.002 + k * course, (256, 384)) for k in (0.6, 0.9, 0.9, 0.5)])


def patches() -> np.ndarray:
    row = np.repeat([0.01, 0.05, 0.2, 0.5], 50)
    return np.broadcast_to(row, (4, 200, 200))


def photograph(name: str) -> np.ndarray:
    linear = (getattr(skimage.data, name)() / 255.0) ** 2.2
    return np.moveaxis(linear * [0.5, 1.0, 0.65], -1, 0)[[0, 1, 1, 2]]


def soft(name: str) -> np.ndarray:
    return gaussian_filter(photograph(name), (0, 1, 1))


def with_noise(light: np.ndarray, nlf: NoiseLevelFunction) -> np.ndarray:
    """Gaussian noise of the NLF's variance, clipped with a pedestal and quantised to 14 bits."""
    rng = np.random.default_rng(1)
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    noisy = light + np.sqrt(shot * light + read) * rng.standard_normal(light.shape)
    return np.round(np.clip(noisy, -0.065, 1.0) * 15000) / 15000


def worst_ratio(estimate: NoiseLevelFunction, truth: NoiseLevelFunction) -> tuple[float, float]:
    """Lowest and highest variance, estimated over true, over `LEVELS`, plane-averaged truth."""
    shot, read = np.mean(truth.shot), np.mean(truth.read)
    ratios = [(estimate.read[0] + estimate.shot[0] * x) / (read + shot * x) for x in LEVELS]
    return min(ratios), max(ratios)


@pytest.mark.parametrize(
    ("light", "camera", "iso", "least", "most"),
    [
        (ramp(), "nikon_z6", 12800, 0.88, 1.12),
        (ramp(), "canon_70d", 100, 0.88, 1.12),
        (patches(), "nikon_z6", 12800, 0.88, 1.12),
        (patches(), "canon_70d", 100, 0.88, 1.12),
        (np.tile(ramp(), (1, 6, 4)), "canon_70d", 800, 0.9, 1.1),  # so large that it is sampled
        # No level is smooth, and the bound is the docs'.
        (photograph("astronaut")[:, ::2, ::2], "canon_70d", 800, 0.9, 3.0),
        *((soft("astronaut"), "canon_70d", iso, 0.80, 1.25) for iso in (100, 6400)),
        *((soft("coffee"), "canon_70d", iso, 0.80, 1.25) for iso in (100, 6400)),
    ],
)
def test_noise_that_was_put_in_is_found(light, camera, iso, least, most):
    nlf = get_camera(camera).nlf(iso)
    low, high = worst_ratio(estimate_nlf(with_noise(light, nlf)), nlf)
    assert least < low <= high < most


def test_clipped_halves_dark_frames_and_grey_cards():
    nlf = get_camera("canon_70d").nlf(1600)
    sides = np.full((4, 256, 200), 1.2), np.zeros((4, 256, 90))
    noisy = with_noise(np.concatenate([ramp(), *sides], axis=2), nlf)
    for clipped in (noisy, np.maximum(noisy, 0.0)):  # with a pedestal, and without one
        low, high = worst_ratio(estimate_nlf(clipped), nlf)
        assert 0.85 < low <= high < 1.15
    rng = np.random.default_rng(6)
    noise = rng.standard_normal((4, 128, 128))
    dark = estimate_nlf(1e-3 * noise)
    assert dark.read[0] + 1e-3 * dark.shot[0] == pytest.approx(1e-6, rel=0.15)
    card = estimate_nlf(0.3 + 1e-2 * rng.standard_normal((4, 40, 40_000)))  # below 64 rows
    assert card.read == (0.0,) * 4
    assert 0.3 * card.shot[0] == pytest.approx(1e-4, rel=0.1)
    for data in (rng.random((4, 8, 8)), np.ones((4, 64, 64))):  # these tell no noise
        with pytest.raises(ValueError, match="`data`"):
            estimate_nlf(data)


@pytest.mark.real_data
def test_real_raws_of_one_camera_agree(data_dir):
    """Shot noise is the camera's, whatever the subject; a chart's patches are the reference."""
    folder = data_dir / "canon_crw_cc0"
    raws = {n: read_raw(folder / f"CRW_{n}.CRW") for n in ("0101", "0118")}
    shots = [raw.noise.shot[1] for raw in raws.values()]
    assert max(shots) / min(shots) < 1.15
    nlf = raws["0101"].noise
    # Neutral patches of the ColorChecker, a quadratic surface taken out, variance by least squares.
    y, x = np.mgrid[-1:1:24j, -1:1:24j]
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1).reshape(-1, 6)
    ratios = []
    for left, plane in itertools.product((165, 320, 475), range(4)):
        patch = raws["0101"].data[plane, 610:634, left : left + 24].double().numpy()
        _, (squares,), *_ = np.linalg.lstsq(design, patch.ravel(), rcond=None)
        variance = squares / (patch.size - 6)
        ratios.append(variance / (nlf.read[plane] + nlf.shot[plane] * patch.mean()))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)


# -- developing: against LibRaw, colour-demosaicing, matrix arithmetic and closed forms ------------


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
    curve = developing.apply_tone(linear, "photographic")
    assert (curve.diff() > 0).all()
    assert (curve.diff().diff() < 1e-12).all()  # concave: contrast falls towards the highlights
    card = torch.tensor([0, 0.18 * 0.6635, 1], dtype=torch.float64)
    known = developing.apply_tone(card, "photographic")
    np.testing.assert_allclose(known, [0, 0.18, 1], atol=1e-12)
    encoded = developing.srgb_encode(linear.float()).numpy()
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
    dimmed = render_srgb(raw, exposure_ev=-2.0, tone="linear")
    assert (dimmed == round(255 * float(srgb(np.array(0.25))))).all()  # grey, not magenta


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
    assert render_srgb(raw, "half").shape == light[:3].shape


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


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 5e-7)])
@pytest.mark.parametrize("size", [(4, 4), (4, 10), (6, 4), (22, 34)])
@pytest.mark.parametrize("pattern", [p.value for p in BayerPattern])
def test_malvar_equals_colour_demosaicing_of_a_mirrored_mosaic(pattern, size, dtype, tolerance):
    mosaic = np.random.default_rng(1).random(size)
    red, blue = pattern.index("R"), pattern.index("B")  # packed by the letters alone
    tiles = [mosaic[i // 2 :: 2, i % 2 :: 2] for i in (red, red ^ 1, blue ^ 1, blue)]
    packed = torch.from_numpy(np.stack(tiles))[None].to(dtype)
    ours = developing.demosaic_malvar(packed, pattern)
    assert ours.dtype == dtype
    batch = developing.demosaic_malvar(torch.cat([packed.flip(3), packed]), pattern)
    assert torch.equal(batch[1:], ours)  # each image by itself
    mirrored = np.pad(mosaic, 4, mode="reflect")
    theirs = demosaicing_CFA_Bayer_Malvar2004(mirrored, pattern)[4:-4, 4:-4]
    np.testing.assert_allclose(ours[0].permute(1, 2, 0), theirs, rtol=0, atol=tolerance)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_malvar_on_the_gpu_is_not_rounded():
    packed = torch.rand(2, 4, 9, 8)
    on_gpu = developing.demosaic_malvar(packed.cuda(), "GBRG").cpu()
    expected = developing.demosaic_malvar(packed, "GBRG")
    torch.testing.assert_close(on_gpu, expected, atol=3e-7, rtol=0)


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
        ((4.5, 9.0, 7.2), (1.8, 3.6, 2.88)),  # 1.8 times as bright as red's white
        ((3.0, 0.3, 0.2), (1.0, 0.3, 0.2)),  # a red lamp stays red
        ((0.9, 1.0, 0.2), (0.9, 1.0, 0.2)),  # of the levels 1.8 and 0.25 the lower
    ],
)
def test_clipped_planes_become_as_bright_as_white(recorded, expected) -> None:
    raw = clipped(recorded)
    light = neutral_highlights(raw, raw.saturated)
    np.testing.assert_allclose(light[[0, 1, 3], 0, 0], expected, rtol=1e-6)
    assert light[2].equal(light[1])


@pytest.mark.parametrize(
    "light",
    [*((v,) * 4 for v in (0.92, 0.97, 1.0, 1.02, 1.06)), (1.0, 2.0, 2.0, 4 / 3)],
)
def test_what_noise_alone_clips_stays_near_white(light: tuple[float, ...], monkeypatch) -> None:
    """A flat patch at ISO 6400: nothing measured is replaced, and the rest is off by the noise."""
    deviation, true = 0.03, torch.tensor(light)[:, None, None]
    nlf = NoiseLevelFunction((deviation**2,) * 4, (0.0,) * 4)
    noise = deviation * torch.randn(4, 48, 48, generator=torch.Generator().manual_seed(0))
    recorded = (true + noise).clamp(max=1.0)
    raw = RawImage(recorded, BASE, Z6, nlf, white_balance=(2.0, 1.0, 1.5))
    found = neutral_highlights(raw, raw.saturated)
    measured = recorded < 1.0 - 1e-4
    assert found[measured].equal(recorded[measured])
    assert (found >= recorded).all()
    inner = found[:, 3:-3, 3:-3] / true
    assert (inner - 1.0).square().mean().sqrt() < 1.1 * deviation
    # Planes of a large raw are looked at one by one, each with the noise of its own.
    raw = replace(raw, nlf=NoiseLevelFunction((1e-4, 4e-4, 9e-4, 16e-4), (0.0,) * 4))
    together = neutral_highlights(raw, raw.saturated)
    monkeypatch.setattr(developing, "_SMALL_PX", 0)
    assert neutral_highlights(raw, raw.saturated).equal(together)


def test_full_below_white_an_absurd_balance_and_one_measured_sample() -> None:
    """Some compact cameras' photosites are full below white; of others such a value is measured."""
    raw = clipped((1.0, 1.0, 1.0))
    raw.data[1] = 0.94  # a smaller full well than the other green's
    found = neutral_highlights(raw, raw.saturated)[:, 0, 0].tolist()
    assert found == pytest.approx([1.0, 0.94, 1.0, 1.0])  # the level 0.94 is below white
    raw = replace(raw, camera=replace(Z6, full_level=0.92))
    found = neutral_highlights(raw, raw.saturated)[:, 0, 0].tolist()
    assert found == pytest.approx([1.8, 3.6, 3.6, 2.88])
    raw = clipped((1.0, 1.0, 1.0), balance=(1e30, 1.0, 1.0))
    assert neutral_highlights(raw, raw.saturated).max() == 16.0
    raw = RawImage(torch.ones(4, 64, 64), replace(BASE, iso=3200), Z6, None, (2.0, 1.0, 1.5))
    raw.data[1, 32, 32] = 0.995  # one sample near white tells nothing of the lamp around it
    lamp = neutral_highlights(raw, raw.saturated)[:, 24, 24]
    torch.testing.assert_close(lamp, torch.tensor([1.8, 3.6, 3.6, 2.4]), rtol=0.01, atol=0)


@pytest.mark.parametrize("ratio", [1 / 16, 4.0])
def test_captures_and_scenes_show_neutral_highlights(ratio: float) -> None:
    pixels = [(v / 2, v, v / 1.25) for v in WHITE]
    raw, settings = clipped(*pixels), CameraSettings(100, ratio / 64, 4)
    prepared = CameraSimulator(device="cpu").prepare(raw)
    # A quarter is clipped, others are 0.26 below white: 2 (1 + 0.26 / 2 + 0.8 / 4^4), red's is 2.
    level = torch.tensor([0.5, 1.1, 1.6, 2.26625]) * ratio
    expected = level / torch.tensor([2, 1, 1, 1.25])[:, None]
    scene = Scene.from_raw(raw, scene_id="raw")
    assert (scene.illuminance, scene.reference) == (None, raw.settings)
    for found in (prepared, scene.prepared):
        light = found.expected(settings)[:, 0]
        torch.testing.assert_close(light, expected)
        if ratio >= 1.0:  # as bright as the clipped raw would be
            as_clipped = (raw.data[:, 0] * ratio).clamp(max=1.0)
            assert (light.clamp(max=1.0) - as_clipped).abs().max() < 1e-6
        assert found.saturated.tolist() == [[False, True, True, True]]
    black = RawImage(torch.cat([raw.data, torch.zeros(4, 3, 4)], 1), BASE, Z6, None, BALANCE)
    small = Scene.from_raw(black, scene_id="raw").resized(1).light.flatten()
    expected[:, 3] *= (1.26625 + 0.8 / 16**4) / 1.133125  # a 16th, the others 0.852 below
    torch.testing.assert_close(small, expected.mean(1) / ratio / 4)  # averaged after, not before
    dark = clipped(pixels[0])
    assert Scene.from_raw(dark, scene_id="raw").saturated is None
    assert CameraSimulator(device="cpu").prepare(dark).light is dark.data
