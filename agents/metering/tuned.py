"""The regression of tuned programs: from readings to the expected scores of all states."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.policy import Floats
from simulator.networks.weights import read_weights
from simulator.utils.files import read_bounded, write_atomically

#: Bandwidths tried for EV and, in the same units (stops), for speed and defocus.
EV_BANDWIDTHS = (0.35, 0.6, 1.0)
SENSOR_BANDWIDTHS = (1.0, 1.5, 2.2)
FOLDS = 8
#: Bandwidths whose criterion [score] is this near to the best are as good.
INDIFFERENCE = 0.001
#: Weight of the prior that the local fit shrinks to: the fit with all bandwidths widened.
SHRINKAGE = 1.0
WIDER = 3.0
#: Ridge on the slopes of the local fit, relative to the kernel's weight.
RIDGE = 0.05


@dataclass(frozen=True)
class ScoreRegression:
    """Kernel regression of the scores of all states on a few readings (Fan and Gijbels 1996).

    A local linear fit, weighted by a Gaussian kernel; where few training samples are near, it
    shrinks to the same fit with three times the bandwidths, and that one to the mean.
    """

    features: Floats  # (n, d) readings of the training episodes [stops]
    scores: Floats  # (n, S) expected score of every state there
    bandwidths: Floats  # (d,) standard deviation of the kernel [stops]

    @classmethod
    def fit(cls, features: Floats, scores: Floats, groups: NDArray[Any]) -> ScoreRegression:
        """Choose the bandwidths by cross-validation over source `groups` (n,): one is never split.

        The criterion is the mean score of the state that the regression picks for the groups left
        out (8 folds); the bandwidth of the EV, the first feature, is chosen first, then that of the
        sensors. Of those within 0.001 of the best the widest is taken: the criterion is flat,
        narrow kernels are not safe where few scenes are near.
        """
        dimensions = features.shape[1]
        folds = np.unique(groups, return_inverse=True)[1] % FOLDS

        def bandwidths(ev: float, sensors: float) -> Floats:
            return np.array([ev, *[sensors] * (dimensions - 1)])

        def criterion(candidate: Floats) -> float:
            """Mean score of the states picked for each fold by the regression on the others."""
            total = 0.0
            for fold in np.unique(folds):
                held = folds == fold
                if held.all():  # a single group: nothing to choose by
                    return float(scores.mean())
                model = cls(features[~held], scores[~held], candidate)
                picked = model.predict(features[held]).argmax(axis=1)
                total += float(np.take_along_axis(scores[held], picked[:, None], axis=1).sum())
            return total / len(scores)

        sensors = SENSOR_BANDWIDTHS[1]
        ev = _widest_good(EV_BANDWIDTHS, [criterion(bandwidths(b, sensors)) for b in EV_BANDWIDTHS])
        if dimensions > 1:
            found = [criterion(bandwidths(ev, b)) for b in SENSOR_BANDWIDTHS]
            sensors = _widest_good(SENSOR_BANDWIDTHS, found)
        return cls(features, scores, bandwidths(ev, sensors))

    def predict(self, features: Floats) -> Floats:
        """Expected scores of all states at these readings, ``(N, S)``.

        Readings outside the range of the training ones (an overexposed frame may read any EV) are
        taken to be at its end: a local fit must not extrapolate.
        """
        features = np.clip(features, self.features.min(axis=0), self.features.max(axis=0))
        mean = self.scores.mean(axis=0)
        prior = np.broadcast_to(mean, (len(features), self.scores.shape[1]))
        for widen in (WIDER, 1.0):
            prior = self._local_fit(features, self.bandwidths * widen, prior)
        return prior

    def _local_fit(self, features: Floats, bandwidths: Floats, prior: Floats) -> Floats:
        """Ridge-regularised local linear fit around each query, shrunk to `prior`."""
        known, query = self.features / bandwidths, features / bandwidths
        # Squared distances through the inner product: no (N, n, d) array.
        square = (query**2).sum(1)[:, None] + (known**2).sum(1)[None] - 2.0 * query @ known.T
        weights = np.exp(-0.5 * np.maximum(square, 0.0))  # (N, n)
        count, d = len(features), known.shape[1]
        design = np.concatenate([np.ones((len(known), 1)), known], axis=1)  # (n, d + 1)
        products = (design[:, :, None] * design[:, None, :]).reshape(len(known), -1)
        gram = (weights @ products).reshape(count, d + 1, d + 1)
        targets = (design[:, :, None] * self.scores[:, None, :]).reshape(len(known), -1)
        moment = (weights @ targets).reshape(count, d + 1, -1)
        # Move the origin to the query: z - z_q, so that the intercept is the prediction.
        shift = np.broadcast_to(np.eye(d + 1), (count, d + 1, d + 1)).copy()
        shift[:, 1:, 0] = -query
        gram = shift @ gram @ shift.transpose(0, 2, 1)
        moment = shift @ moment
        gram[:, 0, 0] += SHRINKAGE
        moment[:, 0] += SHRINKAGE * prior
        diagonal = np.arange(1, d + 1)
        gram[:, diagonal, diagonal] += RIDGE * gram[:, :1, 0] + 1e-9
        solution: Floats = np.linalg.solve(gram, moment)[:, 0]
        return solution

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the regression as a safetensors file."""
        from safetensors.numpy import save

        content = save({name: np.ascontiguousarray(v) for name, v in vars(self).items()})
        return write_atomically(path, content)

    @classmethod
    def load(cls, path: str | os.PathLike[str], name: str = "path") -> ScoreRegression:
        """Read what `save` wrote; a `ValueError`, where `name` names the file, if it is none."""
        try:
            found = read_weights(read_bounded(Path(path), 2**30))
            names = [field.name for field in fields(cls)]
            if sorted(found) != sorted(names):
                raise ValueError(f"it must hold {', '.join(names)}")
            features, scores, bandwidths = (found[name].double().numpy() for name in names)
            fits = features.ndim == scores.ndim == 2 and bandwidths.shape == features.shape[1:]
            if not (fits and len(features) == len(scores) and features.size and scores.size):
                shapes = features.shape, scores.shape, bandwidths.shape
                raise ValueError(f"its shapes {shapes} are not (n, d), (n, S) and (d,)")
            if not (bandwidths > 0.0).all():
                raise ValueError("its bandwidths must be > 0")
            return cls(features, scores, bandwidths)
        except (OSError, ValueError) as error:
            raise ValueError(f"`{name}` (={str(path)!r}) holds no tuned program: {error}") from None


def _widest_good(bandwidths: Sequence[float], criteria: Sequence[float]) -> float:
    best = max(criteria)
    return max(b for b, c in zip(bandwidths, criteria, strict=True) if c >= best - INDIFFERENCE)
