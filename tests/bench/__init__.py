"""Figures, not tests: `make bench`."""

import os

# OpenBLAS's second thread spins for some 30 ms after every product, into whatever is timed next: before numpy is met.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
