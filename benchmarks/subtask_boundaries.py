"""Beginnings of subtasks, compared with the skill boundaries that LOTUS publishes for the same human demonstrations.

LOTUS (github.com/UT-Austin-RPL/Lotus, branch ``website``) segments LIBERO's demonstrations by the features of their
frames, without knowledge of contacts or goals. Its boundaries are multiples of ten steps. The branch has pictures of
the first, the middle and the last step of many segments: ``docs/static/data/<suite>/<task>_demo/<demo>/<step>.png``.
All segments of its ``downsampled_data.hdf5`` are among them. LISTING has the paths of the branch, a line each:

    git ls-tree -r --name-only origin/website docs/static/data > LISTING
    python benchmarks/subtask_boundaries.py LISTING

Each demonstration of the starter set is replayed with its no-ops, so both sides count the same steps.
"""

import json
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import ReplayConfig
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import tasks
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay
from pipeline.physics.subtasks import subtasks
from pipeline.types import Demo

PATH = re.compile(r"docs/static/data/(libero_\w+)/(.+)_demo/(demo_\d+)/(\d+)\.png")
SUITES = {"libero_goal": "libero_goal", "libero_object": "libero_object", "libero_kitchen": "libero_90"}
"""LOTUS's name of a suite to LIBERO's."""

PICTURES = 3
"""Pictures of a segment: its first, its middle and its last step."""

REPLAY = ReplayConfig(mode="open_loop", noops="keep")


def boundaries(listing: Iterable[str]) -> dict[str, list[tuple[int, int]]]:
    """Return the first step of each published segment and the step after its last, by ``<suite>/<task>/<demo>``."""
    steps: dict[str, list[int]] = defaultdict(list)
    for line in listing:
        match = PATH.fullmatch(line.strip())
        if match and match[1] in SUITES:
            steps[f"{SUITES[match[1]]}/{match[2]}/{match[3]}"].append(int(match[4]))
    segments = {}
    for name, pictures in steps.items():
        pictures.sort()
        segments[name] = [(first, last + 1) for first, _, last in zip(*[iter(pictures)] * PICTURES, strict=True)]
    return segments


def compare(demo: Demo, segments: Iterable[tuple[int, int]]) -> dict[str, Any] | None:
    """Compare a demonstration's subtasks with its segments; `None` if nothing can be compared.

    Returns:
        ``apart``: steps between each inner boundary of LOTUS and the nearest beginning of a subtask. ``chance``: the
        mean of this number over all steps. ``texts``: first word of that subtask.
    """
    steps = len(demo.actions)
    # LOTUS's last segments end one step before the end of the recording.
    inner = sorted({step for segment in segments for step in segment if 0 < step < steps - 1})
    environment = Environment(demo.task)
    try:
        trajectory = replay(environment, demo, "boundaries", REPLAY)
    finally:
        environment.close()
    found = [subtask for subtask in subtasks(trajectory, demo.task) if subtask.step > 0]
    if not inner or not found or not trajectory.verdict.kept:
        return None
    starts = np.array([subtask.step for subtask in found])
    every = np.abs(np.arange(1, steps)[:, None] - starts).min(axis=1)
    nearest = [int(np.abs(starts - step).argmin()) for step in inner]
    return {
        "apart": [int(starts[index] - step) for index, step in zip(nearest, inner, strict=True)],
        "chance": float(every.mean()),
        "texts": [found[index].text.split()[0] for index in nearest],
    }


def figures(results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the figures over all compared boundaries."""
    apart = np.array([step for result in results.values() for step in result["apart"]])
    chance = np.concatenate([[result["chance"]] * len(result["apart"]) for result in results.values()])
    by_text: dict[str, list[int]] = defaultdict(list)
    for result in results.values():
        for text, step in zip(result["texts"], result["apart"], strict=True):
            by_text[text].append(abs(step))
    return {
        "demonstrations": len(results),
        "boundaries": len(apart),
        "median_steps": float(np.median(np.abs(apart))),
        "mean_steps": round(float(np.abs(apart).mean()), 1),
        "within_10_steps": round(float((np.abs(apart) <= 10).mean()), 3),
        "mean_signed_steps": round(float(apart.mean()), 1),
        "mean_steps_by_chance": round(float(chance.mean()), 1),
        "median_steps_by_word": {text: [len(steps), float(np.median(steps))] for text, steps in by_text.items()},
    }


def main(listing: Path) -> None:
    segments, results = boundaries(listing.read_text().splitlines()), {}
    for suite in SUITES.values():
        for task in tasks(suite):
            demo = StarterSource().demonstration(task)
            if demo.demo_id in segments:
                result = compare(demo, segments[demo.demo_id])
                print(demo.demo_id, len(demo.actions), segments[demo.demo_id], result, flush=True)
                if result is not None:
                    results[demo.demo_id] = result
    print(json.dumps(figures(results)))


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main(Path(sys.argv[1]))
