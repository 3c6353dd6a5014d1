"""Helpers: checks of arguments, presets, user code and model files."""
