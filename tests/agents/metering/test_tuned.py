import numpy as np
import pytest

from agents.metering.tuned import ScoreRegression


def _samples(count=600, seed=0):
    rng = np.random.default_rng(seed)
    features = rng.uniform(-4, 4, (count, 2))
    peaks = np.linspace(-4, 4, 9)
    scores = np.exp(-0.5 * (features[:, :1] + 0.5 * features[:, 1:] - peaks) ** 2)
    return features, scores, np.arange(count) % 40


def test_a_linear_surface_is_reproduced_away_from_the_data_edge():
    rng = np.random.default_rng(1)
    features = rng.uniform(-2, 2, (4000, 2))
    scores = np.stack([0.3 + 0.1 * features[:, 0], 0.5 - 0.05 * features[:, 1]], axis=1)
    model = ScoreRegression(features, scores, np.array([0.4, 0.4]))
    query = rng.uniform(-1.5, 1.5, (50, 2))
    expected = np.stack([0.3 + 0.1 * query[:, 0], 0.5 - 0.05 * query[:, 1]], axis=1)
    np.testing.assert_allclose(model.predict(query), expected, atol=0.01)


def test_outside_the_training_range_it_does_not_extrapolate():
    features, scores, _ = _samples()
    model = ScoreRegression(features, scores, np.array([0.3, 0.3]))
    far = model.predict(np.array([[500.0, -500.0], [1e9, 0.0]]))
    edge = model.predict(np.array([[features[:, 0].max(), features[:, 1].min()]]))
    np.testing.assert_allclose(far[0], edge[0])
    assert ((far > -0.2) & (far < 1.2)).all()


def test_fit_picks_nearly_the_best_state_of_unseen_samples():
    model = ScoreRegression.fit(*_samples())
    features, scores, _ = _samples(seed=7)
    picked = model.predict(features).argmax(axis=1)
    regret = scores.max(axis=1) - scores[np.arange(len(scores)), picked]
    assert regret.mean() < 0.01


def test_save_and_load_give_the_same_regression(tmp_path):
    model = ScoreRegression.fit(*_samples(200))
    again = ScoreRegression.load(model.save(tmp_path / "deep" / "tuned.safetensors"))
    query = np.array([[0.1, 0.2], [3.0, -3.0]])
    np.testing.assert_array_equal(model.predict(query), again.predict(query))
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["tuned.safetensors"]


def test_load_says_what_is_wrong_with_a_file(tmp_path):
    with pytest.raises(ValueError, match=r"missing\.safetensors"):
        ScoreRegression.load(tmp_path / "missing.safetensors")
    (tmp_path / "text").write_text("no tensors here")
    with pytest.raises(ValueError, match="`path`"):
        ScoreRegression.load(tmp_path / "text")
