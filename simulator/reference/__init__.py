"""The reference camera, its thin lens and its sequences: the ground truth."""
