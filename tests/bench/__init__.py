"""Benchmarks (`make bench`): figures with limits, not tests."""

import os

# OpenBLAS's second thread spins for some 30 ms after every product, into the next timed run: set before numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
