"""One module for each part that `benchmark.py` measures; `command` names them."""
