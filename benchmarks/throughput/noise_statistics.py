"""The noise of the environment's frames, from the bank and drawn anew, put to the same tests.

Frames of an even grey scene are taken by the environment itself, so that whatever it does to the
bank is tested and not the bank alone. What is tested is the frame less its known mean, over its
known standard deviation.
"""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import torch
from scipy import stats

import ae_env  # noqa: F401  registers the environment
from ae_env.scenes import Scene
from simulator import CameraSettings, NoiseLevelFunction, get_camera

SIDE = 64
#: Light of the scene, and what is photographed: much noise beside a digital number, far from clips.
_GREY = 0.3
_STATE = CameraSettings(6400, 1 / 64, 4.0)
#: Lags that autocorrelations are taken over [pixel, frame].
LAGS = 16
NAMES = {
    "mean": "mean",
    "variance": "variance",
    "skewness": "skewness",
    "excess_kurtosis": "excess kurtosis",
    "ks_distance": "largest distance of a plane's distribution from the normal (KS)",
    "frame_mean_variance": "variance of a frame's mean, times its samples",
    "spatial": f"largest spatial autocorrelation, up to {LAGS} pixels",
    "temporal": f"largest temporal autocorrelation, up to {LAGS} frames",
    "planes": "largest correlation of two planes of a frame",
    "pairs": "largest correlation of two frames",
    "shifted": "largest correlation of two frames at any shift",
}


def measure_noise(noise: str, frames: int, seed: int) -> dict[str, float]:
    """Statistics by name (see `NAMES`), and ``samples``.

    Args:
        noise: ``"bank"`` or ``"exact"``.
        frames: Frames of each of 8 episodes.
        seed: Of the episodes.
    """
    normals = _normals(noise, frames, seed)  # (T, B, 4, H, W)
    samples = normals.ravel()
    per_frame = normals.reshape(*normals.shape[:2], -1)
    flat = per_frame.reshape(-1, per_frame.shape[-1])
    return {
        "samples": float(samples.size),
        "mean": float(samples.mean(dtype=np.float64)),
        "variance": float(samples.var(dtype=np.float64)),
        "skewness": float(stats.skew(samples)),
        "excess_kurtosis": float(stats.kurtosis(samples)),
        "ks_distance": max(_ks_distance(normals[:, :, plane]) for plane in range(4)),
        "frame_mean_variance": float(flat.mean(axis=1).var() * flat.shape[1]),
        "spatial": _spatial(normals),
        "temporal": max(
            abs(_correlation(per_frame[lag:], per_frame[:-lag])) for lag in range(1, LAGS + 1)
        ),
        "planes": _largest_pair(normals[:16].reshape(-1, SIDE * SIDE), group=4),
        "pairs": _largest_pair(flat),
        "shifted": _shifted(flat[:64]),
    }


def _normals(noise: str, frames: int, seed: int) -> np.ndarray:
    camera = get_camera("nikon_z6")
    nothing = NoiseLevelFunction.zero()
    scene = Scene(
        scene_id="grey",
        group="grey",
        light=torch.full((4, SIDE, SIDE), _GREY),
        reference=_STATE,
        camera=camera,
        nlf=nothing,
        illuminance=None,
        white_balance=(1.0, 1.0, 1.0),
        kind="grey",
    )
    envs = gym.make_vec(
        "ae_env/AutoExposure-v0",
        num_envs=8,
        max_episode_steps=None,
        scenes=[scene],
        resolution=SIDE,
        observation="linear",
        noise=noise,
        motion="none",
        depth="far",
        grid={"isos": [_STATE.iso], "exposure_times": [_STATE.exposure_time], "f_numbers": [4.0]},
    )
    envs.reset(seed=seed)
    action = np.zeros(8, np.int64)
    taken = np.stack([envs.step(action)[0]["raw"] for _ in range(frames)])
    nlf = camera.nlf(_STATE.iso)
    variance = np.array(nlf.read) + np.array(nlf.shot) * _GREY + 1 / (12 * np.square(camera.span))
    deviation = np.sqrt(variance).astype(np.float32)[:, None, None]
    return (taken - np.float32(_GREY)) / deviation


def _ks_distance(samples: np.ndarray) -> float:
    """Largest distance of the samples' distribution from the standard normal one.

    Samples of one plane are whole digital numbers: the distribution is compared between them.
    """
    values, counts = np.unique(samples, return_counts=True)
    between = (values[1:].astype(np.float64) + values[:-1]) / 2
    share = counts.cumsum()[:-1] / samples.size
    return float(np.abs(share - stats.norm.cdf(between)).max())


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float((a * b).mean(dtype=np.float64))


def _spatial(normals: np.ndarray) -> float:
    """Largest autocorrelation over all shifts up to `LAGS` rows and columns but none."""
    spectrum = np.zeros((2 * SIDE, SIDE + 1))
    for frame in normals.reshape(-1, 4, SIDE, SIDE):
        transform = np.fft.rfft2(frame, s=(2 * SIDE, 2 * SIDE))
        spectrum += np.square(np.abs(transform)).sum(axis=0)
    sums = np.fft.irfft2(spectrum, s=(2 * SIDE, 2 * SIDE))
    count = normals.size // (SIDE * SIDE)
    found = []
    for row in range(LAGS + 1):
        for column in range(-LAGS, LAGS + 1):
            if (row, column) > (0, 0):
                overlap = count * (SIDE - row) * (SIDE - abs(column))
                found.append(abs(sums[row, column]) / overlap)
    return float(max(found))


def _largest_pair(images: np.ndarray, group: int | None = None) -> float:
    """Largest correlation of two different rows of (N, K), or of two within each `group` rows."""
    largest = 0.0
    for part in [images] if group is None else np.split(images, len(images) // group):
        products = np.abs(part @ part.T) / part.shape[1]
        np.fill_diagonal(products, 0.0)
        largest = max(largest, float(products.max()))
    return largest


def _shifted(images: np.ndarray) -> float:
    """Largest correlation of two of the images (N, K), read line by line, at any cyclic shift."""
    transforms = np.fft.rfft(images)
    largest = 0.0
    for i in range(len(images) - 1):
        products = np.fft.irfft(transforms[i].conj() * transforms[i + 1 :], n=images.shape[1])
        largest = max(largest, float(np.abs(products).max()))
    return largest / images.shape[1]
