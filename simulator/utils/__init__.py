"""Cache, files, results, tiles, threads and compiled kernels."""
