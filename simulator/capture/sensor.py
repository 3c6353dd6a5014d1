"""The sensor: from linear light to the numbers that the camera records.

The order is physical, and it matters: exposed light, not clipped -> motion and defocus blur of
that unclipped light -> the light of each row, where it flickers -> noise of that signal -> clip ->
quantise, each of the last two once. (Exposure and blur are linear and change places here: one blur
then serves many exposures.)

`record` is the one way from light to frames: sweeps, the full run and the environment all take it.
On the CPU it is one fused kernel (`simulator.capture.kernels`), elsewhere, and where the read noise
has rows and tails, the steps one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.exposure import LIGHT_LIMIT, SIGNAL_LIMIT, Exposure, exposure_table
from simulator.capture.kernels import record_frames
from simulator.noise.generator import Noise, frame_normals, noise_keys
from simulator.noise.noise_level_function import VARIANCE_LIMIT, plane_tensor
from simulator.noise.read_noise import ReadNoise
from simulator.noise.top_up import missing_variance, top_up_table
from simulator.optics.blur import disc_blur, motion_blur
from simulator.utils.compute import parallel_ranges

_TINY = torch.finfo(torch.float32).tiny
#: Samples whose noise is balanced at a time: they stay in the cache, and on one thread.
_BALANCED = 2**15


# -- a batch of frames ------------------------------------------------------------------------


@dataclass
class Transitions:
    """All that B frames depend on, except for their noise.

    Args:
        light: (4, H, W) each, contiguous float32: blurred already, at the exposure of its
            prepared scene. Several may be the same.
        table: (B, 5, 4) of `simulator.capture.exposure.exposure_table`.
        remaining_variance: `Exposure.remaining_variance` of each, contiguous float32; None for
            all of the variance. None in place of the sequence where no frame has any.
    """

    light: Sequence[torch.Tensor]
    table: np.ndarray
    remaining_variance: Sequence[torch.Tensor | None] | None = None

    @classmethod
    def of(cls, lights: Sequence[torch.Tensor], exposures: Sequence[Exposure]) -> Transitions:
        """Those of lights that are blurred already."""
        shares = [e.remaining_variance for e in exposures]
        return cls(
            [light.contiguous() for light in lights],
            exposure_table(exposures),
            [None if share is None else share.float().contiguous() for share in shares],
        )

    def in_bands(self, row_gain: np.ndarray) -> Transitions:
        """The same where rows have light of their own: the bands of flickering light.

        The light of each row multiplies the blurred light before there is noise, so that the noise
        is that of the banded signal: exact for motion along the rows; other motion blurs across
        rows that do not share their light. Noise that the source itself brings is multiplied with
        its light: its variance by the square of the row's gain, r^2. What the top-up takes away for
        it has the variance times r: exact for shot noise, whose variance is worked out from the
        banded signal, and off by r (1 - r) of the source's read noise.

        Args:
            row_gain: (B, H) light of each row relative to the frame's.
        """
        lights, width = list(self.light), self.light[0].shape[-1]
        shares = self.shares()
        noisy = self.table[:, 3:].max(axis=(1, 2)) > 0.0  # the source is
        for i in np.flatnonzero(row_gain.max(axis=1) > row_gain.min(axis=1)).tolist():
            gain = torch.from_numpy(row_gain[i]).float()[:, None].to(lights[i].device)
            lights[i] = (lights[i] * gain).contiguous()
            if noisy[i]:
                share, known = gain.expand(-1, width), shares[i]
                shares[i] = (share if known is None else share * known).contiguous()
        return Transitions(lights, self.table, shares)

    def before_rounding(self, camera: CameraProfile) -> Transitions:
        """The same without the variance that rounding to whole digital numbers will add, 1/12.

        It is part of the calibrated read noise: the rest of that is what has to be drawn.
        """
        table = self.table.copy()
        table[:, 2] -= 1.0 / (12.0 * np.square(np.array(camera.span, np.float32)))
        return replace(self, table=table)

    def averaged_table(self) -> np.ndarray:
        """`table` in which each source's noise is what its blur leaves in the mean."""
        if self.remaining_variance is None:
            return self.table
        left = [1.0 if share is None else float(share.mean()) for share in self.shares()]
        kept, table = np.array(left, np.float32)[:, None, None], self.table.copy()
        table[:, 1:3] += (1.0 - kept) * table[:, 3:]
        table[:, 3:] *= kept
        return table

    def shares(self) -> list[torch.Tensor | None]:
        """`remaining_variance` as a list, one entry for each frame."""
        known = self.remaining_variance
        return [None] * len(self.light) if known is None else list(known)

    @property
    def lacks_noise(self) -> bool:
        """Whether any signal could have less noise than its target; else none need be drawn."""
        if (self.table[:, 1:3] > 0.0).any():
            return True
        return any(share is not None for share in self.shares())


def record(
    transitions: Transitions,
    camera: CameraProfile,
    *,
    keys: np.ndarray | None = None,
    noise: Noise = "exact",
    read_noise: Sequence[ReadNoise] | None = None,
    row_gain: np.ndarray | None = None,
    signals: torch.Tensor | None = None,
    codes: np.ndarray | None = None,
    numbers: np.ndarray | None = None,
    count: bool = False,
) -> np.ndarray:
    """Records a batch of frames: exposes, adds noise, clips and quantises.

    Every output that is given is filled; `codes`, `numbers` and `count` on the CPU only.

    Args:
        transitions: Light and exposures.
        camera: The body.
        keys: (B,) uint64 of the noise; None for none.
        noise: How the keys become noise.
        read_noise: Rows and tails of each frame's read noise, for the noise ``"sensor"``.
        row_gain: See `Transitions.in_bands`; None where all rows have the frame's light.
        signals: (B, 4, H, W) contiguous float32 in [-pedestal, 1], where white is 1.
        codes: (B, 4, H, W) uint8, companded.
        numbers: (B, 4, H, W) uint16, digital numbers.
        count: Whether clipped samples are counted.

    Returns:
        (B, 2) int64: samples of each frame that are clipped low, and high; 0 without `count`.
    """
    if len(transitions.light) == 0:
        return np.zeros((0, 2), np.int64)
    if row_gain is not None:
        transitions = transitions.in_bands(row_gain)
    transitions = transitions.before_rounding(camera)
    table, on_cpu = transitions.table, transitions.light[0].is_cpu
    if read_noise is not None and keys is not None:
        if signals is None:
            signals = torch.empty(len(table), *transitions.light[0].shape)
        record_stepwise(transitions, camera, keys, "exact", signals, read_noise)
        if not on_cpu or (codes is None and numbers is None and not count):
            return np.zeros((len(table), 2), np.int64)
        # What is recorded already passes the fused kernel unchanged, which fills the rest.
        table, keys = np.zeros_like(table), None
        table[:, 0] = 1.0
        transitions, signals = Transitions(list(signals), table), None
    if on_cpu:
        return record_frames(
            transitions.light,
            table,
            camera,
            keys=keys,
            noise=noise,
            remaining_variance=transitions.remaining_variance,
            codes=codes,
            numbers=numbers,
            signals=None if signals is None else signals.numpy(),
            count=count,
        )
    assert signals is not None
    record_stepwise(transitions, camera, keys, noise, signals)
    return np.zeros((len(transitions.light), 2), np.int64)


# -- the steps one by one ---------------------------------------------------------------------


def sensor_light(prepared: torch.Tensor, exposure: Exposure) -> torch.Tensor:
    """Light on the sensor, (4, H, W): exposed and blurred, neither noisy nor clipped."""
    light = prepared
    if exposure.defocus_px or exposure.motion_px:  # else even the brightest light stays exact
        light = motion_blur(defocused_light(prepared, exposure.defocus_px), exposure.motion_px)
    return exposed_light(light, exposure)


def defocused_light(prepared: torch.Tensor, defocus_px: float) -> torch.Tensor:
    """Light (4, H, W) of a scene behind an aperture, still at the prepared scene's exposure.

    Blur and exposure are linear, so the blur may come first: it then serves every exposure time
    and ISO.
    """
    return disc_blur(prepared.clamp(-LIGHT_LIMIT, LIGHT_LIMIT), defocus_px)


def exposed_light(light: torch.Tensor, exposure: Exposure) -> torch.Tensor:
    """Light on the sensor, (4, H, W), of `light` that has the blur of `exposure` already."""
    return _limited(light * exposure.ratio)


def _limited(signal: torch.Tensor) -> torch.Tensor:
    return signal.clamp_(-SIGNAL_LIMIT, SIGNAL_LIMIT)


def record_stepwise(
    transitions: Transitions,
    camera: CameraProfile,
    keys: np.ndarray | None,
    noise: Noise,
    signals: torch.Tensor,
    read_noise: Sequence[ReadNoise] | None = None,
) -> None:
    """`record` on any device: what the fused kernel is held against. Fills `signals`."""
    for i, (light, table) in enumerate(zip(transitions.light, transitions.table, strict=True)):
        signal = _limited(light * table[0, 0].item())
        if keys is not None:
            missing = missing_variance(signal, table[1:], transitions.shares()[i])
            normals = frame_normals(int(keys[i]), tuple(light.shape), noise)
            drawn = torch.from_numpy(normals).to(signal.device)
            missing.clamp_(min=0.0)
            if read_noise is not None:
                share, own = transitions.shares()[i], read_noise[i]
                signal = signal + _read_part(missing, table, share, int(keys[i]), own)
            signal = missing.sqrt_().mul_(drawn).add_(signal)
        signals[i] = clip_and_quantise(signal, camera)


def _read_part(
    missing: torch.Tensor,
    table: np.ndarray,
    remaining_variance: torch.Tensor | None,
    key: int,
    read_noise: ReadNoise,
) -> torch.Tensor:
    """Read noise with rows and tails; its variance is taken out of `missing` (4, H, W), in place.

    A source's read noise counts as having rows and tails of the same kind.
    """
    planes, height, width = missing.shape
    dark = missing_variance(missing.new_zeros(planes, 1, 1), table[1:], remaining_variance)
    read = torch.minimum(dark.clamp(min=0.0), missing)
    missing -= read
    row_key, pixel_key = (int(noise_keys(np.array([key], np.uint64), n)[0]) for n in (1, 2))
    rows = torch.from_numpy(frame_normals(row_key, (1, 2, height))[0]).to(missing)
    pixels = torch.from_numpy(frame_normals(pixel_key, (planes, height, width))).to(missing)
    shared = plane_tensor(table[2].clip(min=0.0), missing.device)
    own = read_noise.pixel_part((1.0 - read_noise.row**2) * read, pixels)
    return read_noise.row_part(shared, rows) + own


def clip_and_quantise(signal: torch.Tensor, camera: CameraProfile) -> torch.Tensor:
    """The camera's digital numbers of `signal` (..., 4, H, W), on the scale where white is 1."""
    device = signal.device
    span = torch.tensor(camera.span, dtype=torch.float32, device=device)[:, None, None]
    black = torch.tensor(camera.black_level, dtype=torch.float32, device=device)[:, None, None]
    numbers = (signal * span).add_(black).round_().clamp_(0.0, camera.white_level)
    return numbers.sub_(black).div_(span)


# -- excess variance --------------------------------------------------------------------------


@dataclass(frozen=True)
class NoiseBalance:
    """The noise that a source brings against the noise that a capture should have.

    Args:
        relative_excess_variance: Mean over the pixels of the variance beyond the target's,
            relative to it.
        excess_variance: Mean of that variance, 1 is sensor white squared.
        lacks_noise: Whether any pixel has less noise than the target.
    """

    relative_excess_variance: float
    excess_variance: float
    lacks_noise: bool


def noise_balance(light: torch.Tensor, exposure: Exposure) -> NoiseBalance:
    """Compares the noise that one image brings with the target's.

    Args:
        light: (4, H, W) at the exposure of the prepared scene.
        exposure: Its exposure; neither its ratio nor its noise are in `light` yet.
    """
    source, target = exposure.source_noise, exposure.target
    if source.is_zero:
        return NoiseBalance(0.0, 0.0, not target.is_zero)
    (table,), remaining = top_up_table([source], [target]), exposure.remaining_variance
    height, width = light.shape[-2:]
    rows = max(1, _BALANCED // width)
    parts = [slice(top, top + rows) for top in range(0, height, rows)]
    relative, excess, lacks = np.zeros(4), np.zeros(4), np.zeros(4, bool)

    def balance(first: int, last: int) -> None:
        for plane in range(first, last):
            if table[0, plane] >= 0.0 and table[1, plane] > 0.0:
                lacks[plane] = True  # at every pixel, whatever its light
                continue
            for part in parts:
                signal = (light[plane, part] * exposure.ratio).clamp_(0.0, SIGNAL_LIMIT)
                share = None if remaining is None else remaining[part]
                missing = missing_variance(signal, table[:, plane], share)
                lacks[plane] |= bool((missing > 0).any())
                wanted = signal.mul_(target.shot[plane]).add_(target.read[plane])
                missing.clamp_(max=0.0)
                excess[plane] -= float(missing.sum())
                relative[plane] -= float((missing / wanted.clamp_(min=_TINY)).sum())

    parallel_ranges(balance, 4, threads=None if len(parts) > 4 else 1)
    count = light.numel()
    share = min(abs(float(relative.sum())) / count, VARIANCE_LIMIT)  # finite over no noise, too
    return NoiseBalance(share, abs(float(excess.sum())) / count, bool(lacks.any()))
