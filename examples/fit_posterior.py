"""Fits the posterior of unknown light anew: the constants of simulator/radiance/incident_light.py.

    AE_ENV_DATA=folder/of/real/files python examples/fit_posterior.py

The weights are of a ridge regression of the gap between the incident light and an average meter's
reading on standardised features, over 48 views of each training map. The spread is judged, not
fitted: which share of the views lies within its intervals, in training places that are left out in
turn and in validation places. Takes some minutes; needs the maps (`ae-env scenes download`).
"""

import numpy as np
from scipy.stats import norm

from ae_env.scenes.polyhaven import polyhaven_scenes
from ae_env.scenes.scene import SceneRequest
from simulator import get_camera
from simulator.radiance.incident_light import POSTERIOR, features
from simulator.radiance.light import mean_anchor

VIEWS, PENALTY, SHARES = 48, 300.0, (0.5, 0.8, 0.9, 0.95)


def read(split):
    """Place (N,), features (N, 10) and gap (N,) [EV] of the views of a split."""
    found = []
    for scene in polyhaven_scenes(SceneRequest(split, get_camera("nikon_z6"), 64), views=VIEWS):
        light, green = scene.incident_light, scene.light[1:3].mean(dim=0)
        if (meter := light.reflected_ev100) is not None:
            numbers = features(green * mean_anchor(green), meter)
            found.append((scene.group, numbers, light.ev100 - meter))
    return tuple(np.array(column) for column in zip(*found, strict=True))


def fit(x, y):
    """Weights (10,) and offset of the gap `y` (N,) as a linear function of the features `x`."""
    mean, deviation = x.mean(axis=0), x.std(axis=0)
    z = (x - mean) / deviation
    penalty = PENALTY * np.eye(z.shape[1])
    weights = np.linalg.solve(z.T @ z + penalty, z.T @ (y - y.mean())) / deviation
    return weights, y.mean() - mean @ weights


def covered(errors):
    """Shares of `errors` [EV] within the intervals of the spread in use, as text."""
    shares = [np.mean(np.abs(errors) < POSTERIOR.spread * norm.ppf(0.5 + s / 2)) for s in SHARES]
    return ", ".join(f"{s:.0%}: {own:.1%}" for s, own in zip(SHARES, shares, strict=True))


if __name__ == "__main__":
    places, x, y = read("train")
    weights, offset = fit(x, y)
    print("weights", np.round(weights, 3).tolist(), "offset", round(float(offset), 3))
    print("in use ", list(POSTERIOR.weights), "offset", POSTERIOR.offset)
    left_out = np.empty(len(y))
    for place in np.unique(places):
        own = places == place
        without, constant = fit(x[~own], y[~own])
        left_out[own] = y[own] - constant - x[own] @ without
    _, x, y = read("validation")
    print(f"intervals of the spread in use, {POSTERIOR.spread} EV")
    print("  training places, left out in turn:", covered(left_out))
    print("  validation places:", covered(y - offset - x @ weights))
