"""Sensor noise: noise level functions, and the generator of frames of noise."""
