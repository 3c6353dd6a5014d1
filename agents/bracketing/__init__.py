"""Policies for `ExposureBracket-v0`: which frames to take for a merged picture."""
