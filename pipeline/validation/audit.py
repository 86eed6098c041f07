"""How near a dataset comes to the benchmark's test tasks, whoever made it and whatever was done to it since.

What an episode shows counts first: the instruction, and the matrices of the camera where the dataset has them. Of the
other axes only this project's labels tell (``perturbations``), in the dataset or, by ``episode_id``, in a manifest.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import tensorflow_datasets as tfds

from pipeline.axes import AXES, from_json, to_json
from pipeline.axes.base import Perturbation
from pipeline.axes.camera_pose import AGENT_VIEWS, moved_to
from pipeline.axes.language import LanguagePerturbation, load_bank
from pipeline.axes.language_lint import normalise
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.formats.lerobot_columns import EPISODE_ID, camera_column
from pipeline.formats.tfrecord import METADATA, columns, records
from pipeline.libero import bddl
from pipeline.libero.tasks import find_task, tasks
from pipeline.planning.leakage import AxisDistance, Compared
from pipeline.planning.leakage import check as compare
from pipeline.tables import read_table
from pipeline.testset.benchmark import TESTED_SUITES, TestSet
from pipeline.types import Floats, Task

LABELS = ("suite", "task", "perturbations")


@dataclass(frozen=True)
class Found:
    """What a dataset tells of one episode.

    Attributes:
        episode_id: this project's name of it, or what the dataset calls it.
        instruction: what the policy is told; None where the dataset has no text.
        extrinsics: (4, 4) from the agent view to the world (z forward, y down); None where the dataset has none.
        suite, task: of the labels, perhaps of no task that is known here; None where nothing tells.
        perturbations: the labels, as the manifest writes them; None where there are none.
    """

    episode_id: str
    instruction: str | None
    extrinsics: Floats | None = None
    suite: str | None = None
    task: str | None = None
    perturbations: str | None = None


@dataclass(frozen=True)
class Audit:
    """What an audit found.

    Attributes:
        axes: axis to how close its episodes come to the test tasks.
        unlabelled: episodes without labels, of which nothing is known but the instruction and the camera.
        without_camera: unlabelled episodes without the camera's matrices.
        without_task: episodes that no known task was found for.
        without_instruction: episodes without a text to compare.
        unplaced: axis to the episodes that it perturbs and whose task is not known, so nothing can be compared.
    """

    episodes: int
    axes: dict[str, AxisDistance]
    unlabelled: int
    without_camera: int
    without_task: int
    without_instruction: int
    unplaced: dict[str, int]

    @property
    def unknown(self) -> dict[str, int]:
        """Axis to the number of episodes of which nothing tells whether it perturbs them."""
        counts = Counter({axis: self.unlabelled for axis in AXES if axis != "language"})
        counts |= {"camera": self.without_camera, "language": self.without_instruction}
        counts.update(self.unplaced)
        return {axis: count for axis, count in counts.items() if count}


def audit(dataset: Path, test: TestSet, manifest: Path | None = None) -> Audit:
    """Compare every episode of a dataset with the benchmark's test tasks.

    Args:
        dataset: a folder with an RLDS set (as TFDS writes it) or a LeRobot set (v3.0 or v2.1), or several below it.
        manifest: gives the labels of episodes that have an ``episode_id`` and lost theirs.

    Raises:
        PipelineError: when there is no such dataset, or it cannot be read.
    """
    known = {} if manifest is None else _manifest(manifest)
    episodes = [
        replace(one, **{name: known[one.episode_id][name] for name in LABELS})
        if one.perturbations is None and one.episode_id in known
        else one
        for one in read(dataset)
    ]
    found = [_task_of(one) for one in episodes]
    rows = [_row(one, task, test) for one, task in zip(episodes, found, strict=True)]
    without_task = [one for one, task in zip(episodes, found, strict=True) if task is None]
    return Audit(
        episodes=len(episodes),
        axes=compare(rows, test),
        unlabelled=sum(one.perturbations is None for one in episodes),
        without_camera=sum(one.perturbations is None and one.extrinsics is None for one in episodes),
        without_task=len(without_task),
        without_instruction=sum(one.instruction is None for one in episodes),
        unplaced=dict(Counter(p.axis for one in without_task for p in _labels(one) if _needs_task(p))),
    )


def read(dataset: Path) -> Iterator[Found]:
    """The episodes of a dataset, or of all those below a folder.

    Raises:
        PipelineError: when there is none, or it cannot be read.
    """
    rlds, lerobot = (
        # A hidden folder has what is not finished.
        sorted(file for file in dataset.rglob(name) if not re.search(r"(^|/)\.", str(file.relative_to(dataset))))
        for name in ("features.json", "meta/info.json")
    )
    if not rlds and not lerobot:
        raise PipelineError(
            "no dataset below this folder",
            where=dataset,
            expected="features.json, as TFDS writes it, or meta/info.json, as lerobot does",
        )
    try:
        for file in rlds:
            yield from _rlds(file.parent)
        for file in lerobot:
            yield from _lerobot(file.parents[1])
    except (OSError, ValueError, KeyError) as error:
        raise PipelineError(f"cannot be read ({type(error).__name__}: {error})", where=dataset) from error


def _rlds(folder: Path) -> Iterator[Found]:
    features = tfds.builder_from_directory(folder).info.features
    for shard in sorted(folder.glob("*.tfrecord*")):
        for number, record in enumerate(records(shard)):
            step = columns(record, features)
            said = {name.removeprefix(METADATA): value for name, value in step.items() if name.startswith(METADATA)}
            text = {name: said[name][0].decode() for name in ("episode_id", *LABELS) if name in said}
            episode_id, instruction = text.pop("episode_id", ""), step["language_instruction"][0].decode()
            yield Found(
                episode_id or f"{shard.name}:{number}", instruction or None, said.get("image_extrinsics"), **text
            )


def _lerobot(folder: Path) -> Iterator[Found]:
    if (lines := folder / "meta" / "episodes.jsonl").is_file():
        episodes = [json.loads(line) for line in lines.read_text().splitlines()]
    else:
        files = sorted((folder / "meta" / "episodes").rglob("*.parquet"))
        named = ["episode_index", "tasks"]
        episodes = [row for file in files for row in pq.read_table(file, columns=named).to_pylist()]
    # Tools that delete, split or merge leave the provenance behind, and a folder may have both.
    provenance = folder / "meta" / "provenance.parquet"
    stored = pq.read_table(provenance).to_pylist() if provenance.is_file() else []
    labels = {row["episode_index"]: row for row in stored}
    ids = {} if labels else _ids(folder)
    for episode in episodes:
        index = episode["episode_index"]
        row = labels.get(index, {})
        matrix = row.get(camera_column("image", "extrinsics"))
        yield Found(
            row.get(EPISODE_ID) or ids.get(index) or f"episode {index}",
            next(iter(episode["tasks"]), None),
            None if matrix is None else np.reshape(matrix, SCHEMA.extrinsics.shape),
            **{name: row.get(name) for name in LABELS},
        )


def _ids(folder: Path) -> dict[int, str]:
    found: dict[int, str] = {}
    for file in sorted((folder / "data").rglob("*.parquet")):
        if EPISODE_ID in pq.read_schema(file).names:
            table = pq.read_table(file, columns=["episode_index", EPISODE_ID])
            found |= dict(zip(table["episode_index"].to_pylist(), table[EPISODE_ID].to_pylist(), strict=True))
    return found


def _manifest(file: Path) -> dict[str, Mapping[str, Any]]:
    names = ["episode_id", *LABELS]
    rows = read_table(file, names, remedy="name the manifest of the run that the dataset is from").select(names)
    return {row["episode_id"]: row for row in rows.to_pylist()}


def _row(one: Found, task: Task | None, test: TestSet) -> Compared:
    """What an episode shows in the axes' own parameters; what only labels tell is taken from these."""
    seen = [p for p in _labels(one) if task is not None or not _needs_task(p)]
    if one.extrinsics is not None:
        seen = [p for p in seen if p.axis != "camera"]
        arenas = list(AGENT_VIEWS) if task is None else [bddl.read(task.bddl_file).arena]
        cameras = [moved_to(one.extrinsics, arena) for arena in arenas]
        if None not in cameras:
            anywhere = tasks(TESTED_SUITES[0])[0]
            seen.append(min((c for c in cameras if c), key=lambda c: c.nearest(test, anywhere).distance))
    rewrites = []
    if one.instruction is not None and (task is None or normalise(one.instruction) != normalise(task.instruction)):
        rewrites = [LanguagePerturbation(component="paraphrase", level=1, text=one.instruction)]
    if task is None:  # an unknown episode is compared with the task whose test instructions come nearest
        every = [task for suite in TESTED_SUITES for task in tasks(suite)]
        task = min(every, key=lambda task: rewrites[0].nearest(test, task).distance) if rewrites else every[0]
    return Compared(one.episode_id, task.suite, task.name, to_json([*seen, *rewrites]))


def _labels(one: Found) -> list[Perturbation]:
    """The labels of an episode but language, which its instruction shows."""
    labels = () if one.perturbations is None else from_json(one.perturbations)
    return [p for p in labels if p.axis != "language"]


def _needs_task(perturbation: Perturbation) -> bool:
    """Whether it is compared only with the test tasks of one task or scene."""
    return perturbation.same is not None


def _task_of(one: Found) -> Task | None:
    """By the labels, else by the instruction; labels may name a suite of somebody else's."""
    if one.suite and one.task:
        try:
            return find_task(one.suite, one.task)
        except PipelineError:
            return None
    return None if one.instruction is None else _tasks_by_text().get(normalise(one.instruction))


@cache
def _tasks_by_text() -> dict[str, Task]:
    """Own instructions and rewrites of the tasks that the benchmark perturbs, normalised."""
    by_text: dict[str, Task] = {}
    bank = load_bank()
    for suite in TESTED_SUITES:
        for task in tasks(suite):
            rewrites = [text for texts in bank.get(suite, {}).get(task.name, {}).values() for text in texts]
            for text in (*rewrites, task.instruction):
                by_text[normalise(text)] = task
    return by_text
