"""Strategies of property tests: settings, camera bodies, grids and images of any shape."""

import math

import numpy as np
import torch
from hypothesis import strategies as st

from ae_env.grid import ExposureGrid
from simulator import CameraSettings, NoiseLevelFunction
from simulator.camera import BayerPattern, CameraProfile
from simulator.capture.prepared_scene import PreparedScene

SEEDS = st.integers(0, 2**32 - 1)
#: Single pixels, rows and columns, odd sizes; 256 samples make a block of a kernel.
SHAPES = st.one_of(
    st.tuples(st.integers(1, 6), st.integers(1, 6)),
    st.sampled_from([(1, 257), (300, 1), (17, 31)]),
)
#: Any light at all, and values where it is likely to go wrong.
LIGHT = st.one_of(
    st.floats(-2.0, 2.0, width=32),
    st.floats(allow_nan=False, allow_infinity=False, width=32),
    st.sampled_from([0.0, -0.0, 1.0, -1e6, 1e6, 2.0**-126, 2.0**-149]),
)


def log_uniform(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers in [low, high], as likely in each octave, and both ends."""
    inner = st.floats(math.log(low), math.log(high)).map(lambda x: min(max(math.exp(x), low), high))
    return st.one_of(inner, st.sampled_from([low, high]))


def settings_within(iso=(1e-3, 1e8), exposure_time=(1e-9, 1e5), f_number=(0.5, 1024.0)):
    """Strategy of settings within these ranges."""
    ranges = iso, exposure_time, f_number
    return st.builds(CameraSettings, *(log_uniform(*limits) for limits in ranges))


#: Of real cameras.
USUAL_SETTINGS = settings_within((50, 409_600), (1 / 8000, 30), (1, 32))


@st.composite
def cameras(draw: st.DrawFn) -> CameraProfile:
    """Bodies of any CFA order, levels and depth, calibrated at one ISO."""
    white = draw(st.integers(1, 2**16 - 1))
    quarters = st.integers(0, 4 * white - 1).map(lambda number: number / 4)
    black = draw(st.one_of(quarters.map(lambda b: (b,) * 4), st.tuples(*[quarters] * 4)))
    ranges = (1e-6, 1e-2), (1e-9, 1e-3)  # of shot and read noise
    nlf = NoiseLevelFunction(*(draw(st.tuples(*[log_uniform(*r)] * 4)) for r in ranges))
    order = draw(st.sampled_from(list(BayerPattern)))
    depth = white.bit_length()
    return CameraProfile("drawn", order, black, white, depth, nlf_by_iso={100.0: nlf})


@st.composite
def lights(draw: st.DrawFn, elements: st.SearchStrategy[float] = LIGHT) -> torch.Tensor:
    """(4, H, W) float32 of a few drawn values in a random order."""
    height, width = draw(SHAPES)
    values = np.array(draw(st.lists(elements, min_size=1, max_size=12)), np.float32)
    order = np.random.default_rng(draw(SEEDS)).integers(0, len(values), (4, height, width))
    return torch.from_numpy(values[order])


@st.composite
def mosaics(draw: st.DrawFn, bodies: st.SearchStrategy[CameraProfile]) -> tuple:
    """A body and digital numbers (2H, 2W) of it, with black and white among them."""
    camera, (height, width) = draw(bodies), draw(SHAPES)
    rng, white = np.random.default_rng(draw(SEEDS)), int(camera.white_level)
    numbers = rng.integers(0, white + 1, (2 * height, 2 * width))
    ends = rng.random(numbers.shape)
    numbers = np.where(ends < 0.1, 0, np.where(ends > 0.9, white, numbers))
    return camera, numbers.astype(np.uint16)


def prepared(light, reference, camera, nlf=None, **fields) -> PreparedScene:
    """`light` ready to be exposed, noise-free by default."""
    return PreparedScene(light, reference, camera, nlf or NoiseLevelFunction.zero(), **fields)


@st.composite
def grids(draw: st.DrawFn) -> ExposureGrid:
    ranges = (50.0, 409_600.0), (1 / 8000, 30.0), (1.0, 32.0)
    lists = (st.lists(log_uniform(*r), min_size=1, max_size=4, unique=True) for r in ranges)
    return ExposureGrid(*(tuple(sorted(draw(values))) for values in lists))
