"""Checks, presets and code of the user."""
