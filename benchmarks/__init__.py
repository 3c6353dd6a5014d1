"""The measurements behind `docs/results`; `ae-env bench NAME` runs one of them."""
