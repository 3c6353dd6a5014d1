"""Tests of the simulator's training."""
