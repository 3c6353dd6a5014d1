"""The protocol that compares policies: episodes, metrics, intervals, rankings, plans."""
