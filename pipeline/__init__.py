"""Perturbed robot fine-tuning data from LIBERO demonstrations.

Importing this package fixes which machine code computes, so it must come before NumPy: see ``pipeline.machine_code``.

It also fixes how much free memory a process keeps. Dask has its workers give back to the system every 64 KB that are
free; where software renders, each frame may then ask for thousands of pages anew, up to a tenth of a worker's time.
"""

import ctypes

from pipeline.machine_code import fix

fix()

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Numbers of glibc's malloc.h. What another C library has instead, it keeps as it is."""

if hasattr(ctypes.CDLL(None), "mallopt"):
    ctypes.CDLL(None).mallopt(M_TRIM_THRESHOLD, 256 << 20)
    ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, 32 << 20)
