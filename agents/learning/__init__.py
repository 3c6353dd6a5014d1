"""The learnt agents: networks, training, weights, and the adapter to Stable-Baselines3."""
