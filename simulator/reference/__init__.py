"""The reference camera and its sequences: the ground truth."""
