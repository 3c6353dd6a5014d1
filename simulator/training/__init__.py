"""Training of the simulator's modules on pairs of captures of the same scene."""
