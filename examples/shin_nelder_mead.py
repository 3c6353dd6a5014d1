"""Shin's control of exposure time and gain: a Nelder-Mead search whose values are real frames.

    ae-env evaluate --policy examples/shin_nelder_mead.py:ShinNelderMead --policy shim:P

U. Shin, J. Park, G. Shim, F. Rameau, I. S. Kweon, "Camera exposure control for robust robot vision
with noise-aware image quality assessment", IROS 2019; the control is written from its description,
without the authors' code or settings. The metric is
`ae_env.scorers.measures.shin_metric`: gradient, entropy and noise, this one of flat pixels that are
neither dark nor white. Ours are: the size of the first simplex, when a simplex counts as converged,
the threshold of a restart, the state of the grid nearest to a point, and the way out of frames that
show nothing, where the metric is flat.
"""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
import torch

from ae_env.observation import linear_signal
from ae_env.scorers.measures import shin_metric
from agents.metering.reading import BLACK_SIGNAL, GREEN, WHITE_SIGNAL, frame_states
from agents.metering.search_meters import encoded
from agents.policy import Bools, Floats, Ints, Observations, Policy, PolicyContext, masked_argmax
from simulator.utils.checks import check_number

#: Share of white, or of black, pixels from which a frame shows nothing, and its metric in a search.
NOTHING_SHOWN, WORST = 0.9, -100.0

Search = Generator[Floats, float, Floats]


def nelder_mead(simplex: Floats, tolerance: float) -> Search:
    """Minimise over (n + 1, n) vertices: yields a point, is sent its value, returns the best.

    Reflection 1, expansion 2, contraction and shrinkage 1/2. It ends when no vertex is farther than
    `tolerance` from the best in any coordinate.

    Source: J. A. Nelder, R. Mead, "A simplex method for function minimization", 1965; the order of
    the comparisons is SciPy's.
    """
    simplex, values = np.array(simplex, np.float64), np.empty(len(simplex))
    for i, vertex in enumerate(simplex):
        values[i] = yield vertex
    while True:
        order = np.argsort(values, kind="stable")
        simplex, values = simplex[order], values[order]
        if np.abs(simplex - simplex[0]).max() <= tolerance:
            return simplex[0]
        centre, worst = simplex[:-1].mean(axis=0), simplex[-1].copy()
        reflected = 2.0 * centre - worst
        value = yield reflected
        if value < values[-2]:
            simplex[-1], values[-1] = reflected, value
            if value < values[0]:
                expanded = 3.0 * centre - 2.0 * worst
                value = yield expanded
                if value < values[-1]:
                    simplex[-1], values[-1] = expanded, value
            continue
        outside = value < values[-1]
        contracted = centre + (0.5 if outside else -0.5) * (centre - worst)
        inner = yield contracted
        if inner <= value if outside else inner < values[-1]:
            simplex[-1], values[-1] = contracted, inner
            continue
        for i in range(1, len(simplex)):
            simplex[i] = simplex[0] + 0.5 * (simplex[i] - simplex[0])
            values[i] = yield simplex[i].copy()


class ShinNelderMead(Policy):
    """Climbs Shin's metric over log2 time and log2 gain, one real frame per value.

    A value counts once the frame in hand was taken at the point asked for, so a delay costs frames
    and misleads nobody. After convergence the best state stays until the metric differs from that
    of its first frame by more than `threshold`.

    Args:
        f_number: Aperture, which the search leaves alone: the grid's nearest.
        step: Edge of the first simplex [stops].
        tolerance: Size of a simplex that counts as converged [stops].
        threshold: Change of the metric, about -10 to 3, that begins another search.
    """

    def __init__(
        self,
        context: PolicyContext,
        f_number: float = 4.0,
        step: float = 2.0,
        tolerance: float = 1.0,
        threshold: float = 0.3,
    ) -> None:
        super().__init__(context)
        self.step = check_number("step", step, 0.01, 20.0)
        self.tolerance = check_number("tolerance", tolerance, 0.01, 20.0)
        self.threshold = check_number("threshold", threshold, 0.0, 100.0)
        f_number = check_number("f_number", f_number, 0.5, 1024.0)
        apex = np.array([(-s.time_value, s.speed_value) for s in context.grid.states])
        self._points: Floats = apex  # (S, 2) log2 time [s] and gain, both brighter upwards
        self._low, self._high = apex.min(axis=0), apex.max(axis=0)
        aperture = np.array([s.aperture_stop / 3.0 for s in context.grid.states])
        off = np.abs(aperture - 2.0 * np.log2(f_number))
        self._off_aperture: Floats = 100.0 * (off - off.min()).round(6)
        self.reset(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forget the searches of `num_envs` cameras."""
        super().reset(num_envs, seed)
        self._cameras = [_Camera() for _ in range(num_envs)]

    def act(self, observations: Observations, action_masks: Bools | None = None) -> Ints:
        """The state that each search asks for next."""
        self.check_reset(observations)
        if "histogram" in observations:
            raise ValueError("`observations` must have frames: statistics show no gradient")
        signal = linear_signal(observations["raw"], self.context.camera, GREEN).mean(axis=1)
        luma = torch.from_numpy(encoded(signal.clip(0.0, 1.0)).astype(np.float32))
        metric = shin_metric(luma).tolist()
        black, white = signal <= BLACK_SIGNAL, signal >= WHITE_SIGNAL
        lost = np.diff([white.mean(axis=(1, 2)), black.mean(axis=(1, 2))], axis=0)[0]
        shown = frame_states(observations, self.context.grid).tolist()
        for i, (camera, state) in enumerate(zip(self._cameras, shown, strict=True)):
            if camera.asked not in (None, state):
                continue  # a frame of an older decision
            allowed = None if action_masks is None else action_masks[i]
            if abs(lost[i]) < NOTHING_SHOWN:
                camera.asked = self._climb(camera, state, metric[i], allowed)
            elif camera.search is not None:
                camera.asked = self._climb(camera, state, WORST, allowed)
            else:  # nothing to climb: a step of time and one of gain
                point = self._points[state] + self.step * np.sign(lost[i])
                camera.asked, camera.held = self._nearest(point, allowed), None
        return np.array([camera.asked for camera in self._cameras], np.int64)

    def _climb(self, camera: "_Camera", state: int, metric: float, allowed: Bools | None) -> int:
        """State to ask for next; the frame in hand is that asked for, at `state`."""
        if camera.search is None:
            if camera.held is not None:  # at rest
                camera.held = metric if np.isnan(camera.held) else camera.held
                if abs(metric - camera.held) <= self.threshold:
                    return state
            camera.search = nelder_mead(self._simplex(state), self.tolerance)
            next(camera.search)  # the first vertex is the frame in hand
        asked = state
        while asked == state:  # a point of the same state has the same value
            try:
                asked = self._nearest(camera.search.send(-metric), allowed)
            except StopIteration as end:
                camera.search, camera.held = None, np.nan
                return self._nearest(end.value, allowed)
        return asked

    def _simplex(self, state: int) -> Floats:
        """Three vertices: `state`, one `step` of time from it, and one of gain, to the inside."""
        here = self._points[state]
        inside = np.where(here + self.step > self._high, -self.step, self.step)
        return here + np.vstack([np.zeros(2), np.diag(inside)])

    def _nearest(self, point: Floats, allowed: Bools | None) -> int:
        """State nearest to a point, in stops of time and gain."""
        distance = np.abs(self._points - np.clip(point, self._low, self._high)).sum(axis=1)
        cost = (distance + self._off_aperture).round(6)
        return int(masked_argmax(-cost[None], None if allowed is None else allowed[None])[0])


@dataclass
class _Camera:
    """One camera's search; `held` is the metric at rest, NaN until it is seen, None in a search."""

    search: Search | None = None
    asked: int | None = None
    held: float | None = None
