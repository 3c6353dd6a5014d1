"""The transition engine: prepared scenes, exposures, plans and batches of captures."""
