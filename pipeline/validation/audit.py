"""Distance of a dataset from the benchmark's test tasks, also of third-party and of edited datasets.

The audit first reads the visible content of an episode: the instruction, and the camera's matrices if the dataset has
them. For the other axes it needs this project's labels (``perturbations``). They come from the dataset or, by
``episode_id``, from a manifest.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from pipeline.axes import AXES, from_json, to_json
from pipeline.axes.base import Perturbation
from pipeline.axes.goal import GoalPerturbation
from pipeline.axes.language import LanguagePerturbation, load_bank
from pipeline.axes.language_lint import normalise
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.formats.lerobot.columns import EPISODE_ID, camera_column
from pipeline.formats.tfrecord import METADATA, columns, info_of, records
from pipeline.libero import bddl
from pipeline.libero.arenas import ARENAS
from pipeline.libero.tasks import SUITES, find_task, tasks
from pipeline.planning.leakage import AxisDistance, Compared
from pipeline.planning.leakage import check as compare
from pipeline.tables import read_table
from pipeline.testset.benchmark import TESTED_SUITES, TestSet
from pipeline.types import Floats, Task
from pipeline.validation.camera_pose import moved_to

LABELS = ("suite", "task", "perturbations")


@dataclass(frozen=True)
class StoredEpisode:
    """An episode as a dataset describes it.

    Attributes:
        episode_id: this project's name of the episode, or else the dataset's.
        instructions: distinct texts that the policy gets at any step; empty if the dataset has no text.
        extrinsics: (4, 4) from the agent view to the world (z forward, y down); `None` if the dataset has no matrices.
        suite, task: labels, which may name a task that this project does not have; `None` without labels.
        perturbations: labels as the manifest writes them; `None` without labels.
    """

    episode_id: str
    instructions: tuple[str, ...]
    extrinsics: Floats | None = None
    suite: str | None = None
    task: str | None = None
    perturbations: str | None = None


@dataclass(frozen=True)
class Audit:
    """The result of an audit.

    Attributes:
        axes: axis to the distance of its episodes from the test tasks.
        unlabelled: number of episodes without labels, which show only their instruction and camera.
        without_camera: number of unlabelled episodes without the camera's matrices.
        without_task: number of episodes that match no task of LIBERO and of the folder ``tasks``.
        without_instruction: number of episodes without an instruction to compare.
        unplaced: axis to the number of episodes that it perturbs but that match no task, so they cannot be compared.
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
        """Map each axis to the number of episodes that it may or may not perturb."""
        hidden = {"instructions": self.without_instruction, "cameras": self.without_camera, "nothing": self.unlabelled}
        counts = Counter({name: hidden[axis.audited] for name, axis in AXES.items()})
        counts.update(self.unplaced)
        return {axis: count for axis, count in counts.items() if count}


def audit(dataset: Path, test: TestSet, manifest: Path | None = None) -> Audit:
    """Compare every episode of a dataset with the benchmark's test tasks.

    Args:
        dataset: a folder with an RLDS set (as TFDS writes it) or a LeRobot set (v3.0 or v2.1), or with several sets.
        manifest: labels for episodes that have an ``episode_id`` but lost their labels.

    Raises:
        PipelineError: when there is no such dataset, or it cannot be read.
    """
    manifest_rows = {} if manifest is None else _manifest(manifest)
    episodes: list[StoredEpisode] = []
    for episode in read(dataset):
        if episode.perturbations is None and episode.episode_id in manifest_rows:
            row = manifest_rows[episode.episode_id]
            labels = {name: row[name] for name in LABELS}
            episodes.append(replace(episode, **labels))
        else:
            episodes.append(episode)
    episode_tasks = [_task_of(episode) for episode in episodes]
    rows = [_row(episode, task, test) for episode, task in zip(episodes, episode_tasks, strict=True)]
    without_task = [episode for episode, task in zip(episodes, episode_tasks, strict=True) if task is None]
    unlabelled = [episode for episode in episodes if episode.perturbations is None]
    unplaced: Counter[str] = Counter()
    for episode in without_task:
        unplaced.update(_not_comparable(episode))
    return Audit(
        episodes=len(episodes),
        axes=compare(rows, test),
        unlabelled=len(unlabelled),
        without_camera=sum(episode.extrinsics is None for episode in unlabelled),
        without_task=len(without_task),
        without_instruction=sum(not episode.instructions for episode in episodes),
        unplaced=dict(unplaced),
    )


def read(dataset: Path) -> Iterator[StoredEpisode]:
    """Yield the episodes of all datasets in or below a folder.

    Raises:
        PipelineError: when there is no dataset, or it cannot be read.
    """
    rlds = _visible_files(dataset, "features.json")
    lerobot = _visible_files(dataset, "meta/info.json")
    if not rlds and not lerobot:
        raise PipelineError(
            "there is no dataset below this folder",
            where=dataset,
            expected="features.json, as TFDS writes it, or meta/info.json, as lerobot does",
        )
    try:
        for file in rlds:
            yield from _rlds(file.parent)
        for file in lerobot:
            yield from _lerobot(file.parents[1])
    except (OSError, ValueError, KeyError) as error:
        raise PipelineError(
            f"the dataset cannot be read ({type(error).__name__}: {error})",
            where=dataset,
            expected="whole datasets of RLDS or LeRobot",
            remedy="copy or download the dataset again into another folder, and audit this folder",
        ) from error


def _visible_files(folder: Path, name: str) -> list[Path]:
    """List the files of a name below a folder, except in hidden folders, which hold unfinished datasets."""
    files = folder.rglob(name)
    return sorted(file for file in files if not re.search(r"(^|/)\.", str(file.relative_to(folder))))


def _rlds(folder: Path) -> Iterator[StoredEpisode]:
    info = info_of(folder)
    count = 0
    for shard in sorted(folder.glob("*.tfrecord*")):
        for number, record in enumerate(records(shard)):
            count += 1
            step = columns(record, info.features)
            stored = {name.removeprefix(METADATA): value for name, value in step.items() if name.startswith(METADATA)}
            text = {}
            for name in (EPISODE_ID, *LABELS):
                # Sets of other origin may store numbers under these names.
                if name in stored and isinstance(stored[name][0], bytes):
                    text[name] = stored[name][0].decode()
            episode_id = text.pop(EPISODE_ID, "") or f"{shard.name}:{number}"
            texts = dict.fromkeys(step["language_instruction"].tolist())
            instructions = tuple(text.decode() for text in texts if text)
            yield StoredEpisode(episode_id, instructions, stored.get("image_extrinsics"), **text)
    _require_whole(folder, count, sum(split.num_examples for split in info.splits.values()))


def _require_whole(folder: Path, count: int, stated: int) -> None:
    """Reject a dataset of which files are missing or only links, or that has no episode.

    Args:
        count: number of episodes that were read.
        stated: number of episodes by the dataset's own description; 0 if it states none.

    Raises:
        ValueError: naming the folder and both numbers.
    """
    if not count or (stated and count != stated):
        raise ValueError(f"{folder} has {count} episodes, and its description states {stated}")


def _lerobot(folder: Path) -> Iterator[StoredEpisode]:
    lines = folder / "meta" / "episodes.jsonl"
    if lines.is_file():
        episodes = [json.loads(line) for line in lines.read_text().splitlines()]
    else:
        files = sorted((folder / "meta" / "episodes").rglob("*.parquet"))
        episodes = []
        for file in files:
            episodes += pq.read_table(file, columns=["episode_index", "tasks"]).to_pylist()
    # Tools that delete, split or merge episodes do not copy the provenance. Then the ids may still be in the data.
    provenance = folder / "meta" / "provenance.parquet"
    stored = pq.read_table(provenance).to_pylist() if provenance.is_file() else []
    labels = {row["episode_index"]: row for row in stored}
    ids = {} if labels else _ids(folder)
    for episode in episodes:
        index = episode["episode_index"]
        row = labels.get(index, {})
        matrix = row.get(camera_column("image", "extrinsics"))
        yield StoredEpisode(
            row.get(EPISODE_ID) or ids.get(index) or f"episode {index}",
            tuple(dict.fromkeys(text for text in episode["tasks"] if text)),
            None if matrix is None else np.reshape(matrix, SCHEMA.extrinsics.shape),
            **{name: row.get(name) for name in LABELS},
        )
    stated = json.loads((folder / "meta" / "info.json").read_text()).get("total_episodes", 0)
    _require_whole(folder, len(episodes), stated)


def _ids(folder: Path) -> dict[int, str]:
    ids: dict[int, str] = {}
    for file in sorted((folder / "data").rglob("*.parquet")):
        if EPISODE_ID in pq.read_schema(file).names:
            table = pq.read_table(file, columns=["episode_index", EPISODE_ID])
            ids |= dict(zip(table["episode_index"].to_pylist(), table[EPISODE_ID].to_pylist(), strict=True))
    return ids


def _manifest(file: Path) -> dict[str, Mapping[str, Any]]:
    names = ["episode_id", *LABELS]
    rows = read_table(file, names, remedy="name the manifest of the dataset's run").select(names)
    return {row["episode_id"]: row for row in rows.to_pylist()}


def _row(episode: StoredEpisode, task: Task | None, test: TestSet) -> Compared:
    """Describe an episode in the axes' parameters, as far as it shows them, or else by its labels."""
    perturbations = [p for p in _labels(episode) if task is not None or not _needs_task(p)]
    # The labels name a task that no test task is of, and that is not defined here.
    unknown = task is None and _of_another_suite(episode)
    if episode.extrinsics is not None and not unknown:
        perturbations = [p for p in perturbations if AXES[p.axis].audited != "cameras"]
        arenas = list(ARENAS) if task is None else [bddl.read(task.bddl_file).arena]
        cameras = [moved_to(episode.extrinsics, arena) for arena in arenas]
        if None not in cameras:
            anywhere = tasks(TESTED_SUITES[0])[0]
            perturbations.append(min((c for c in cameras if c), key=lambda c: c.nearest(test, anywhere).distance))
    rewrites: list[LanguagePerturbation] = []
    for text in () if unknown else episode.instructions:
        if task is None or normalise(text) != normalise(task.instruction):
            rewrites.append(LanguagePerturbation(component="paraphrase", level=1, text=text))
    # Without a task, the episode is compared with the task whose test instructions are nearest.
    compared_tasks = list(chain.from_iterable(map(tasks, TESTED_SUITES))) if task is None else [task]
    nearest, task = None, compared_tasks[0]
    if rewrites:
        # An episode may have several texts; the nearest one counts.
        pairs = product(rewrites, compared_tasks)
        nearest, task = min(pairs, key=lambda pair: pair[0].nearest(test, pair[1]).distance)
    shown = [*perturbations, *([nearest] if nearest else [])]
    return Compared(episode.episode_id, task.suite, task.name, to_json(shown))


def _labels(episode: StoredEpisode) -> list[Perturbation]:
    """Return the labels of an episode, without labels that its instruction shows."""
    labels = () if episode.perturbations is None else from_json(episode.perturbations)
    return [p for p in labels if AXES[p.axis].audited != "instructions"]


def _needs_task(perturbation: Perturbation) -> bool:
    """Return whether the perturbation can be compared only if the task is known."""
    return perturbation.same is not None or isinstance(perturbation, GoalPerturbation)


def _of_another_suite(episode: StoredEpisode) -> bool:
    """Return whether the labels name a suite that is not LIBERO's."""
    return bool(episode.suite) and episode.suite not in SUITES


def _not_comparable(episode: StoredEpisode) -> Iterator[str]:
    """Yield the axes of an episode's labels that cannot be compared with test tasks, as its task is not known here."""
    shown = {label.axis for label in _labels(episode)}
    for label in from_json(episode.perturbations or "[]"):
        if _needs_task(label) if label.axis in shown else _of_another_suite(episode):
            yield label.axis


def _task_of(episode: StoredEpisode) -> Task | None:
    """Find the task by the labels, or else by the instruction; labels may name a third-party suite."""
    if episode.suite and episode.task:
        try:
            return find_task(episode.suite, episode.task)
        except PipelineError:
            return None
    known = (_tasks_by_text().get(normalise(text)) for text in episode.instructions)
    return next(filter(None, known), None)


@cache
def _tasks_by_text() -> dict[str, Task]:
    """Map normalised instructions and their rewrites to the tasks that the benchmark perturbs."""
    by_text: dict[str, Task] = {}
    bank = load_bank()
    for suite in TESTED_SUITES:
        for task in tasks(suite):
            rewrites = chain.from_iterable(bank.get(suite, {}).get(task.name, {}).values())
            for text in (*rewrites, task.instruction):
                by_text[normalise(text)] = task
    return by_text
