"""The statistics of NIQE against SciPy's distributions, loops in NumPy, and themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.ndimage
import scipy.special
import scipy.stats
import skimage.data
import torch

from ae_env.scorers import make_scorer
from ae_env.scorers.niqe import (
    HALF_DISTANCE,
    Niqe,
    NiqeModel,
    block_features,
    fit_asymmetric,
    fit_niqe_model,
    load_niqe_model,
    niqe_distance,
    normalised_luma,
)


def _photographs() -> list[torch.Tensor]:
    pictures = [skimage.data.astronaut(), skimage.data.coffee(), skimage.data.chelsea()]
    return [torch.from_numpy(p.copy()).permute(2, 0, 1) / 255.0 for p in pictures]


@pytest.mark.parametrize("shape", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize(("left", "right"), [(1.0, 1.0), (0.5, 2.0)])
def test_the_fit_finds_the_distribution_of_its_samples(
    shape: float, left: float, right: float
) -> None:
    """Quantiles of SciPy's generalised normal, each side with its own scale and probability."""
    count = 100_001
    half = scipy.stats.gennorm(shape)
    probability = (np.arange(count) + 0.5) / count
    share = left / (left + right)  # of the samples below 0
    below = probability < share
    quantiles = np.where(
        below,
        left * half.ppf(np.clip(0.5 * probability / share, 0.0, 0.5)),
        right * half.ppf(np.clip(1.0 - 0.5 * (1.0 - probability) / (1.0 - share), 0.5, 1.0)),
    )
    samples = torch.from_numpy(np.stack([quantiles, 3.0 * quantiles]))
    alpha, beta_left, beta_right = fit_asymmetric(samples)
    np.testing.assert_allclose(alpha.numpy(), shape, rtol=0.01)
    np.testing.assert_allclose(beta_left.numpy(), [left, 3.0 * left], rtol=0.02)
    np.testing.assert_allclose(beta_right.numpy(), [right, 3.0 * right], rtol=0.02)


def _features_in_numpy(luma: np.ndarray, block: int) -> np.ndarray:
    """NIQE's features of an even number of blocks, as the paper has them: one after the other."""
    gamma = scipy.special.gamma
    shapes = np.arange(0.2, 10.0005, 0.001)
    table = gamma(2 / shapes) ** 2 / (gamma(1 / shapes) * gamma(3 / shapes))

    def fit(x: np.ndarray) -> tuple[float, float, float]:
        left = np.sqrt((x[x < 0] ** 2).mean())
        right = np.sqrt((x[x > 0] ** 2).mean())
        share = left / right
        ratio = np.abs(x).mean() ** 2 / (x**2).mean()
        ratio *= (share**3 + 1) * (share + 1) / (share**2 + 1) ** 2
        a = shapes[np.argmin((table - ratio) ** 2)]
        unit = np.sqrt(gamma(1 / a) / gamma(3 / a))
        return a, left * unit, right * unit

    def blur(x: np.ndarray) -> np.ndarray:
        return scipy.ndimage.gaussian_filter(x, 7 / 6, mode="nearest", radius=3)

    rows = []
    mean = blur(luma)
    deviation = np.sqrt(np.abs(blur(luma**2) - mean**2))
    normalised = (luma - mean) / (deviation + 1)
    for top in range(0, luma.shape[0], block):
        for start in range(0, luma.shape[1], block):
            tile = normalised[top : top + block, start : start + block]
            a, left, right = fit(tile)
            row = [a, (left + right) / 2]
            for shift in ((0, 1), (1, 0), (1, 1), (1, -1)):
                a, left, right = fit(tile * np.roll(tile, shift, axis=(0, 1)))
                row += [a, (right - left) * gamma(2 / a) / gamma(1 / a), left, right]
            rows.append(row)
    return np.array(rows)


def test_features_are_those_of_a_loop_over_blocks() -> None:
    luma = skimage.data.camera()[100:228, 100:292].astype(np.float64)
    features, sharpness = block_features(torch.from_numpy(luma)[None], 64)
    assert features.shape == (1, 6, 36)
    np.testing.assert_allclose(features[0, :, :18].numpy(), _features_in_numpy(luma, 64), rtol=2e-6)
    half, _ = block_features(torch.from_numpy(luma)[None], 64)
    small = torch.nn.functional.interpolate(
        torch.from_numpy(luma)[None, None], scale_factor=0.5, mode="bicubic", antialias=True
    )[0, 0].numpy()
    np.testing.assert_allclose(half[0, :, 18:].numpy(), _features_in_numpy(small, 32), rtol=2e-6)
    _, deviation = normalised_luma(torch.from_numpy(luma)[None])
    assert sharpness[0, 5] == pytest.approx(float(deviation[0, 64:, 128:].mean()))


def test_distance_is_zero_on_its_own_statistics() -> None:
    pictures = _photographs()
    luma = (pictures[0].double() * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0)
    features = block_features((255.0 * luma).round()[None], 96)[0][0].numpy()
    own = NiqeModel(features.mean(axis=0), np.cov(features, rowvar=False))
    assert float(niqe_distance(pictures[0][None], own)) == pytest.approx(0.0, abs=1e-5)
    # Moved by the first feature's deviation, with uncorrelated features: Mahalanobis by hand.
    shift = np.zeros(36)
    shift[0] = 0.6
    wide = NiqeModel(own.mean + shift, 2.0 * np.eye(36) - own.covariance)
    # (S + S') / 2 is the identity.
    assert float(niqe_distance(pictures[0][None], wide)) == pytest.approx(0.6, abs=1e-5)


def test_models_are_kept_without_pickle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("AE_ENV_NIQE", raising=False)
    with pytest.raises(ValueError, match=r"set AE_ENV_NIQE=FILE.*niqe.npz.*modelparameters.mat"):
        make_scorer("niqe")
    model = fit_niqe_model(_photographs(), block=24)
    model.save(tmp_path / "cache" / "niqe.npz")
    authors = {"mu_prisparam": model.mean[None], "cov_prisparam": model.covariance}
    scipy.io.savemat(tmp_path / "modelparameters.mat", authors)
    for file in (tmp_path / "cache" / "niqe.npz", tmp_path / "modelparameters.mat"):
        loaded = load_niqe_model(file)
        np.testing.assert_array_equal(loaded.mean, model.mean)
        np.testing.assert_array_equal(loaded.covariance, model.covariance)
    picture = _photographs()[2][None, :, :96, :96]
    score = make_scorer("niqe").parts["niqe"](picture, None)  # type: ignore[arg-type]
    distance = float(niqe_distance(picture, model))
    assert float(score) == pytest.approx(HALF_DISTANCE / (HALF_DISTANCE + distance))
    np.savez(tmp_path / "pickled.npz", mean=np.array([{}]), covariance=np.eye(36))
    np.savez(tmp_path / "short.npz", mean=np.zeros(35), covariance=np.eye(36))
    np.savez(tmp_path / "nan.npz", mean=np.full(36, np.nan), covariance=np.eye(36))
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "text.mat").write_text("text")
    for name, message in (
        ("pickled.npz", "must be .mat or .npz"),
        ("short.npz", "mean of 36 numbers"),
        ("nan.npz", "finite"),
        ("other.npz", "mu_prisparam and cov_prisparam or mean and covariance"),
        ("text.mat", "must be .mat or .npz"),
        ("nowhere.npz", "cannot be read"),
    ):
        with pytest.raises(ValueError, match=message):
            load_niqe_model(tmp_path / name)
    with pytest.raises(ValueError, match=r"must end in .npz"):
        model.save(tmp_path / "model.mat")


def test_frames_of_any_size_are_scored(tmp_path: Path) -> None:
    file = fit_niqe_model(_photographs(), block=24).save(tmp_path / "own.npz")
    scorer = Niqe(file)
    for size in ((1, 1), (2, 3), (7, 9), (37, 64), (96, 100)):
        pictures = torch.rand(3, 3, *size)
        pictures[1], pictures[2] = 0.0, 1.0
        scores = scorer(pictures, None)  # type: ignore[arg-type]
        assert scores.shape == (3,)
        assert bool(((scores >= 0.0) & (scores <= 1.0)).all())
        if min(size) >= 7:  # a constant frame is not natural
            assert scores[1:].max() < 0.5
