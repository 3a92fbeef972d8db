"""One module for each part that `benchmark.py` measures."""
