"""A metering policy of one's own."""

import numpy as np

from ae_env.observation import decode_observation, decode_settings
from agents import Policy


class HalfGrey(Policy):
    """Brings the mean of the frame to 0.12 of white, at the lowest ISO that reaches it."""

    def act(self, observations, action_masks=None):
        """Chooses the state nearest to the EV100 that the frame asks for."""
        mean = decode_observation(observations["raw"]).mean(axis=(1, 2, 3))
        av, tv, sv = decode_settings(observations["settings"])
        target = av + tv - (sv - 5) + np.log2(np.maximum(mean, 1e-4) / 0.12)  # (N,) EV100
        cost = np.abs(self.context.grid.ev100[None] - target[:, None]).round(1)  # (N, S)
        if action_masks is not None:
            cost = np.where(action_masks, cost, np.inf)
        return cost.argmin(axis=1)  # ties go to the lower index: the lower ISO
