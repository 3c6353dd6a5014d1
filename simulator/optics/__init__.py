"""Blur: discs and streaks; vignetting; lamps."""
