"""What an output format is: one object that writes a dataset, reads it back, and says what belongs to it.

A new format is a subclass of ``Format`` in a file of its own and a line in ``registry.py``. It is imported wherever
formats are listed, so heavy libraries are imported in the methods that need them.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import pyarrow as pa
from numpy.typing import NDArray
from pydantic import BaseModel

from pipeline.errors import PipelineError
from pipeline.files import checksum
from pipeline.seeding import digest
from pipeline.types import Episode, Extra, Frame, Geometry

Load = Callable[[str], Episode]
"""Episode id to episode; picklable, called in worker processes."""

Row = Mapping[str, Any]
"""A row of the manifest."""

Options = TypeVar("Options", bound=BaseModel)


@dataclass(frozen=True)
class Episodes:
    """What a dataset is made of.

    Attributes:
        ids: in the order in which they are written: shuffled, because readers walk a dataset in order.
        load: reads one episode.
        suites: episode id to LIBERO suite.
        content: episode id to a token that changes with anything ``load`` would return.
        demos: episode id to its demonstration, ``<suite>/<task>/<key>``.
    """

    ids: Sequence[str]
    load: Load
    suites: Mapping[str, str]
    content: Mapping[str, str]
    demos: Mapping[str, str] = field(default_factory=dict)

    def by_split(self, validation: float) -> dict[str, list[str]]:
        """``train``, and ``val`` where a share is held out, to their episodes in the order of ``ids``.

        A demonstration is held out with all of its episodes, so that no perturbed episode has its clean twin, or the
        same actions, on the other side. Of each task at least one demonstration stays to train on.

        Args:
            validation: share of each task's demonstrations, by number, rounded; drawn by a hash of its name.

        Raises:
            PipelineError: when the demonstrations are too few to hold any out.
        """
        if not validation:
            return {"train": list(self.ids)}
        by_task: dict[str, set[str]] = {}
        for episode_id in self.ids:
            demo = self.demos[episode_id]
            by_task.setdefault(demo.rpartition("/")[0], set()).add(demo)
        held_out = {
            demo
            for demos in by_task.values()
            for demo in sorted(demos, key=lambda demo: digest("validation", demo))[: round(validation * len(demos))]
            if len(demos) > 1
        }
        if not held_out:
            raise PipelineError(
                f"no task has enough demonstrations to hold {validation:g} of them out",
                where="export.<format>.validation",
                expected=f"{ceil(0.5 / validation)} or more demonstrations of a task",
                remedy="use more demonstrations, a larger share, or 0",
            )
        splits: dict[str, list[str]] = {"train": [], "val": []}
        for episode_id in self.ids:
            splits["val" if self.demos[episode_id] in held_out else "train"].append(episode_id)
        return splits

    def slices(self, members: Sequence[str], pieces: int) -> list[list[str]]:
        """Some of the episodes in slices (see ``split``): as many of ``pieces`` as they are of all, at least one."""
        return split(members, max(1, round(pieces * len(members) / len(self.ids))))


@dataclass(frozen=True)
class Fault:
    """Something off.

    Attributes:
        dataset: a format's name, ``manifest``, or ``frames`` for the store that the datasets were made from.
        episode: its id, or None when it is about the whole dataset.
        what: the fault.
        expected: what would have been right.
    """

    dataset: str
    episode: str | None
    what: str
    expected: str


@dataclass(frozen=True)
class Copy:
    """An episode as a dataset hands it out.

    Attributes:
        dataset: the format's name.
        motion: ``action``, ``state`` and ``joint_state``, each (T, D).
        instructions: one for each step.
        provenance: the columns of ``schemas/episode.json``.
        frames: (view, step) to the decoded frame, for ``sampled`` steps.
        marks: what else stands at each step, by the dataset's own names, each (T,).
        place: where it lies, by the format's columns of the manifest.
        geometry: view to where it is seen from.
        object_poses: (T, 24, 7), None where the dataset has none.
        instances: names of the things that segmentation and poses number.
        encoded: view to the image file of every step; None where frames are stored otherwise.
    """

    dataset: str
    motion: Mapping[str, NDArray[Any]]
    instructions: Sequence[str]
    provenance: Mapping[str, str]
    frames: Mapping[tuple[str, int], Frame]
    marks: Mapping[str, NDArray[Any]]
    place: Mapping[str, Any]
    geometry: Mapping[str, Geometry]
    object_poses: NDArray[Any] | None = None
    instances: Sequence[str] = ()
    encoded: Mapping[str, Sequence[bytes]] | None = None

    def __len__(self) -> int:
        return len(self.motion["action"])


@dataclass(frozen=True)
class Written:
    """A file as the record of its dataset has it.

    Attributes:
        dataset: the format's name.
        file: where it lies.
        sha256: of what was written.
    """

    dataset: str
    file: Path
    sha256: str

    def faults(self) -> list[Fault]:
        """What is off with it, by reading all of it: nothing, or that it is not what was written."""
        expected = f"what its checksum in {self.dataset}.json is of; delete it, and `dvc repro` makes it again"
        try:
            same = checksum(self.file) == self.sha256
        except OSError as error:
            return [Fault(self.dataset, None, f"{self.file}: cannot be read ({error})", expected)]
        return [] if same else [Fault(self.dataset, None, f"{self.file}: was changed since it was written", expected)]


@dataclass(frozen=True)
class Export:
    """The record of a finished dataset, in ``data/<run>/<format>.json``.

    Attributes:
        identity: digest of everything that the dataset's bytes depend on.
        files: all files below the format's folder, each with its SHA-256.
        places: episode id to the format's columns of the manifest.
    """

    identity: str
    files: Mapping[str, str]
    places: Mapping[str, Mapping[str, Any]]


class Format(ABC, Generic[Options]):
    """A format's dataset of one run.

    Args:
        data: the run's folder.
        options: the format's section of the configuration.
        extras: what the episodes have beside the frames.
    """

    name: ClassVar[str]
    """In the configuration's section ``export``, of the folder and the record in ``data/<run>``, and on the command
    line."""
    title: ClassVar[str]
    """For people, and the hub's tag."""
    recipe: ClassVar[int]
    """Counted up with every change of code that changes a byte of the dataset."""
    packages: ClassVar[tuple[str, ...]]
    """Installed packages whose version the bytes depend on."""
    columns: ClassVar[tuple[pa.Field, ...]]
    """Of the manifest: where an episode lies; null when it was dropped."""
    keys: ClassVar[Mapping[str, str]]
    """Each view, ``state``, ``joint_state`` and ``action`` to its name in this format."""
    clients: ClassVar[tuple[str, ...]]
    """The clients of ``finetune.yaml`` that train on this format."""

    def __init__(self, data: Path, options: Options, extras: Sequence[Extra] = ()) -> None:
        self.data = data
        self.options = options
        self.extras = tuple(extras)

    @property
    def folder(self) -> Path:
        """Holds the format's datasets and nothing else."""
        return self.data / self.name

    @property
    def record_file(self) -> Path:
        return self.data / f"{self.name}.json"

    @property
    def work(self) -> Path:
        """Holds what is being made; on the file system of ``folder``, so that a finished dataset is only renamed."""
        return self.data / ".work" / self.name

    def record(self) -> Export:
        """The record of the finished dataset.

        Raises:
            PipelineError: when there is none.
        """
        try:
            record = Export(**json.loads(self.record_file.read_text()))
            return replace(record, files=dict(record.files))
        except (OSError, ValueError, TypeError) as error:
            raise PipelineError(
                f"no finished dataset ({error})", where=self.record_file, remedy=f"dvc repro export_{self.name}"
            ) from error

    def written(self) -> list[Written]:
        """The files of the finished dataset.

        Raises:
            PipelineError: when there is none.
        """
        return [Written(self.name, self.folder / name, sha256) for name, sha256 in self.record().files.items()]

    # Writing: pieces in parallel, each whole or not there, then what joins them.

    @abstractmethod
    def pieces(self, episodes: Episodes) -> dict[str, list[str]]:
        """Path of each piece below the work folder to the ids of its episodes.

        Pieces below ``dataset/`` already lie where the finished dataset has them.
        """

    @abstractmethod
    def write_piece(self, path: Path, episode_ids: Sequence[str], load: Load) -> None:
        """Write a file or a folder, in a worker; one episode at a time is in memory.

        Raises:
            PipelineError: when an episode breaks the schema.
        """

    @abstractmethod
    def assemble(self, work: Path, pieces: Mapping[str, Sequence[str]]) -> dict[str, dict[str, Any]]:
        """Finish ``work/dataset``, which becomes ``folder``, from the pieces.

        Returns:
            Episode id to the values of ``columns``.
        """

    # Reading back, as clients do.

    @abstractmethod
    def check(self, kept: Mapping[str, Row], cache: Path) -> Iterator[tuple[str, Fault]]:
        """What is off with the dataset as a whole, each with ``format``, ``ids`` or ``readable`` as the check's name.

        Args:
            kept: episode id to its row of the manifest.
            cache: a folder for files that reading needs.

        Raises:
            PipelineError: when the dataset cannot be opened.
        """

    @abstractmethod
    def read(self, row: Row, cache: Path) -> Copy | None:
        """An episode, wherever it lies; None when the dataset does not have it.

        Raises:
            PipelineError: when it cannot be read.
        """

    # Publishing.

    def repository_path(self, file: str) -> str:
        """Path in a repository of a file of ``record().files``."""
        return f"{self.name}/{file}"

    def tag(self) -> str | None:
        """What the commit of an upload is tagged, where clients want that."""
        return None

    def viewer(self) -> list[dict[str, str]]:
        """What the hub's viewer shows beside the manifest."""
        return []

    @abstractmethod
    def loading(self, name: str, repository: str, kept: Sequence[Row]) -> str:
        """The card's section on loading the dataset, in Markdown.

        Args:
            name: of the run's datasets.
            repository: of the dataset on the hub.
            kept: the manifest's rows of its episodes.
        """


def sampled(steps: int) -> list[int]:
    """The steps whose frames are decoded: the first, the middle and the last."""
    return sorted({0, steps // 2, steps - 1})


def split(episode_ids: Sequence[str], pieces: int) -> list[list[str]]:
    """Contiguous slices whose sizes differ by at most one, so that their concatenation keeps the caller's order.

    There are ``pieces`` of them, or one per episode when there are fewer episodes than that.

    Raises:
        PipelineError: when there is nothing to write, an id comes twice or ``pieces`` is not positive.
    """
    if not episode_ids:
        raise PipelineError(
            "no episodes to write", expected="1 or more", remedy="read in the manifest why all were dropped"
        )
    twice = [episode_id for episode_id, times in Counter(episode_ids).items() if times > 1]
    if twice:
        raise PipelineError(f"{len(twice)} episodes come twice, such as {twice[0]}", expected="unique ids")
    if pieces < 1:
        raise PipelineError(f"{pieces} output files were asked for", expected="1 or more")
    count = min(pieces, len(episode_ids))
    bounds = [len(episode_ids) * k // count for k in range(count + 1)]
    return [list(episode_ids[start:stop]) for start, stop in pairwise(bounds)]


def column(name: str, values: pa.DataType, meaning: str) -> pa.Field:
    """A column of the manifest."""
    return pa.field(name, values, metadata={"meaning": meaning})
