"""The statistics of NIQE against SciPy's distributions, loops in NumPy, and themselves."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.ndimage
import scipy.special
import skimage.data
import torch

from ae_env.scorers import make_scorer
from ae_env.scorers.niqe import (
    HALF_DISTANCE,
    NiqeModel,
    block_features,
    fit_niqe_model,
    load_niqe_model,
    niqe_distance,
    normalised_luma,
)


def _photographs() -> list[torch.Tensor]:
    pictures = [skimage.data.astronaut(), skimage.data.coffee(), skimage.data.chelsea()]
    return [torch.from_numpy(p.copy()).permute(2, 0, 1) / 255.0 for p in pictures]


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
    picture = torch.from_numpy(luma)[None]
    features, sharpness = block_features(picture, 64)
    assert features.shape == (1, 6, 36)
    small = torch.nn.functional.interpolate(
        picture[None], scale_factor=0.5, mode="bicubic", antialias=True
    )[0, 0].numpy()
    for half, frame, block in ((slice(18), luma, 64), (slice(18, None), small, 32)):
        expected = _features_in_numpy(frame, block)
        np.testing.assert_allclose(features[0, :, half].numpy(), expected, rtol=2e-6)
    _, deviation = normalised_luma(picture)
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
    scorer = make_scorer("niqe").parts["niqe"]
    picture = _photographs()[2][None, :, :96, :96]
    distance = float(niqe_distance(picture, model))
    wanted = HALF_DISTANCE / (HALF_DISTANCE + distance)
    assert float(scorer(picture, None)) == pytest.approx(wanted)  # type: ignore[arg-type]
    for size in ((1, 1), (2, 3), (7, 9), (37, 64)):
        pictures = torch.rand(3, 3, *size)
        pictures[1], pictures[2] = 0.0, 1.0
        scores = scorer(pictures, None)  # type: ignore[arg-type]
        assert scores.shape == (3,)
        assert bool(((scores >= 0.0) & (scores <= 1.0)).all())
        if min(size) >= 7:  # a constant frame is not natural
            assert scores[1:].max() < 0.5
    with pytest.raises(ValueError, match=r"must end in .npz"):
        model.save(tmp_path / "model.mat")


@pytest.mark.parametrize(
    ("name", "arrays", "message"),
    [
        ("a.npz", {"mean": np.array([{}]), "covariance": np.eye(36)}, "must be .mat or .npz"),
        ("a.npz", {"mean": np.zeros(35), "covariance": np.eye(36)}, "mean of 36 numbers"),
        ("a.npz", {"mean": np.full(36, np.nan), "covariance": np.eye(36)}, "finite"),
        ("a.npz", {"a": np.zeros(3)}, "mu_prisparam and cov_prisparam or mean and covariance"),
        ("a.mat", None, "must be .mat or .npz"),
        ("nowhere.npz", None, "cannot be read"),
    ],
)
def test_bad_models_are_refused(tmp_path: Path, name: str, arrays: Any, message: str) -> None:
    (tmp_path / "a.mat").write_text("text")
    if arrays:
        np.savez(tmp_path / name, **arrays)
    with pytest.raises(ValueError, match=message):
        load_niqe_model(tmp_path / name)
