"""Tests of the project, in the folders of its packages."""
