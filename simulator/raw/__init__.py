"""Raw files: reading, decoding, metadata, DNG, developing, noise estimation."""
