"""Evaluations written down: tables, plots, Markdown and a page that holds all of them."""
