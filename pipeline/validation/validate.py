"""Reopen both datasets and the manifest of a finished run, as their readers would, and say what is off.

The datasets are compared with the stores that they were made from; those in turn are held against fresh renderings.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import tensorflow_datasets as tfds
from numpy.typing import NDArray

from pipeline.config import Config
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.files import Edition, edition
from pipeline.run import manifest
from pipeline.run.compute import Run
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.stores import TrajectoryStore
from pipeline.validation import oft, set_checks
from pipeline.validation.checks import CHECKS, Case, Fault
from pipeline.validation.readback import UNREADABLE, Copy, LeRobotSet, from_lerobot, from_rlds, open_lerobot
from pipeline.validation.rerender import rendered, witnesses
from pipeline.validation.shards import METADATA, columns, records
from pipeline.writers import rlds


@dataclass
class Outcome:
    """What checks came to, over any number of episodes.

    Attributes:
        checked: check to how often it was made.
        findings: check to what it found.
        places: episode id to how often RLDS has it.
    """

    checked: Counter[str] = field(default_factory=Counter)
    findings: dict[str, list[Fault]] = field(default_factory=lambda: defaultdict(list))
    places: Counter[str] = field(default_factory=Counter)

    def note(self, check: str, found: Iterable[Fault], checked: int = 1) -> None:
        self.checked[check] += checked
        self.findings[check] += found

    def add(self, other: Outcome) -> None:
        for check, checked in other.checked.items():
            self.note(check, other.findings[check], checked)
        self.places += other.places


def validate(config: Config, run: Run) -> dict[str, Any]:
    """Check a finished run; memory holds one episode in each worker, and the manifest.

    Returns:
        JSON-serialisable: check to how many episodes (or planned rows, or datasets) were ``checked``, and
        ``findings``, each with ``dataset``, ``episode`` (None when it is about the whole), ``what`` and ``expected``.

    Raises:
        PipelineError: when the manifest or the stores cannot be read.
    """
    data = config.data.resolve()
    rows = manifest.read(data / "manifest.parquet")
    kept = {row["episode_id"]: row for row in rows if row["kept"]}
    root = data / "lerobot" / config.export.lerobot.name
    sets = oft.datasets(data / "rlds")
    total = Outcome()
    total.note("counts", set_checks.counts(data, rows), len(rows))
    total.note("format", set_checks.rlds_format(sets), len(sets))
    with tempfile.TemporaryDirectory(prefix=".validate.", dir=data) as cache:
        opened = _opened(root, Path(cache))
        if isinstance(opened, Fault):
            total.note("readable", [opened])
        else:
            total.note("format", set_checks.lerobot_format(opened, config.export.lerobot.frames))
            total.note("ids", set_checks.lerobot_ids(opened, kept), len(kept))
        job = ShardJob(
            config, data, None if isinstance(opened, Fault) else root, Path(cache), frozenset(witnesses(rows))
        )
        for outcome in run(job, sorted((data / "rlds").glob("*/*/*.tfrecord-*")), "validate"):
            total.add(outcome)
    total.note("ids", set_checks.rlds_ids(kept, total.places), len(kept))
    if not any(finding.dataset == "rlds" for finding in total.findings["readable"]):
        # OFT's reader stops at what is damaged.
        statistics = json.loads((data / "dataset_statistics.json").read_text())
        trained = run(partial(set_checks.openvla_oft, statistics), sets, "read as OpenVLA-OFT")
        total.note("openvla_oft", [finding for found in trained for finding in found], len(sets))
    return {
        check: {"checked": checked, "findings": [asdict(finding) for finding in total.findings[check]]}
        for check, checked in total.checked.items()
    }


@dataclass(frozen=True)
class ShardJob:
    """The checks of all episodes of one RLDS shard, wherever else they lie.

    Attributes:
        config: of the run.
        data: its folder.
        root: of its LeRobot dataset, where that can be opened.
        cache: folder for the copies that ``datasets`` makes of what lerobot reads.
        witnesses: ids of the episodes to render anew.
    """

    config: Config
    data: Path
    root: Path | None
    cache: Path
    witnesses: frozenset[str]

    def __call__(self, shard: Path) -> Outcome:
        outcome = Outcome()
        for index, read in enumerate(_episodes(shard)):
            if isinstance(read, Fault):
                outcome.note("readable", [read])
            else:
                self._check(read, f"record {index} of {shard.name}", outcome)
        return outcome

    def _check(self, steps: Mapping[str, NDArray[Any]], place: str, outcome: Outcome) -> None:
        episode_id = steps[f"{METADATA}episode_id"][0].decode()
        outcome.places[episode_id] += 1
        row = _rows(edition(self.data / "manifest.parquet")).get(episode_id)
        if row is None:
            return  # Told by "ids".
        told = f"record {row['rlds_index']} of {row['rlds_shard']}"
        outcome.note("place", [Fault("manifest", episode_id, told, place)] if told != place else [])
        copies, unreadable = [], []
        for dataset, reader in self._readers(steps, episode_id).items():
            try:
                copies.append(reader())
            except UNREADABLE as error:
                what = f"{type(error).__name__}: {error}"
                unreadable.append(Fault(dataset, episode_id, what, "an episode that can be read"))
        outcome.note("readable", unreadable)
        language = self.config.plan.axes.language
        case = Case(
            row=row,
            made=EpisodeLoader(self.data / "plan.parquet", self.data / "frames", self.config.render)(episode_id),
            trajectory=TrajectoryStore(self.data / "trajectories").load(row["trajectory_id"]),
            copies=copies,
            encoded={view: steps[f"observation/{view}"].tolist() for view in SCHEMA.views},
            bank=language.bank if language else None,
        )
        for name, check in CHECKS.items():
            outcome.note(name, check(case))
        if episode_id in self.witnesses:
            outcome.note("rendered", rendered(case))

    def _readers(self, steps: Mapping[str, NDArray[Any]], episode_id: str) -> dict[str, Callable[[], Copy]]:
        readers: dict[str, Callable[[], Copy]] = {"rlds": partial(from_rlds, steps)}
        if self.root is not None:
            readers["lerobot"] = partial(from_lerobot, open_lerobot(self.root, self.cache), episode_id)
        return readers


def _episodes(shard: Path) -> Iterator[dict[str, NDArray[Any]] | Fault]:
    """The columns of every record, and a finding where it goes no further."""
    info = tfds.builder_from_directory(shard.parent).info
    split = info.splits[rlds.SPLIT]
    expected = dict(zip(split.filenames, split.shard_lengths, strict=True)).get(shard.name)
    found = 0
    try:
        for record in records(shard):
            yield columns(record, info.features)
            found += 1
        if found != expected:
            yield Fault("rlds", None, f"{shard.name} has {found} records", f"{expected}, as dataset_info.json says")
    except PipelineError as error:
        yield Fault("rlds", None, str(error), "a whole file")


def _opened(root: Path, cache: Path) -> LeRobotSet | Fault:
    try:
        return open_lerobot(root, cache)
    except UNREADABLE as error:
        return Fault("lerobot", None, f"{type(error).__name__}: {error}", "a dataset that lerobot opens")


@lru_cache(maxsize=1)
def _rows(file: Edition) -> dict[str, dict[str, Any]]:
    return {row["episode_id"]: row for row in manifest.read(file.path) if row["kept"]}
