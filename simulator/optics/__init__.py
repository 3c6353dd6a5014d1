"""Blur: discs, streaks, thin lenses and lamps."""
