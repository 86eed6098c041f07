"""Perturbed robot fine-tuning data from LIBERO demonstrations.

Importing this package fixes which machine code computes, so it must come before NumPy. OpenBLAS and NumPy choose theirs
by the processor, and the last bits of a torque follow from that choice; a contact turns such bits into decimetres.
Every x86 processor with AVX2 uses the code for AVX2 here, so that one demonstration has one trajectory everywhere.
"""

import os

os.environ["OPENBLAS_CORETYPE"] = "Haswell"
os.environ["NPY_DISABLE_CPU_FEATURES"] = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL"
