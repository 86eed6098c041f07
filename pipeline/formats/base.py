"""What an output format is: one object that writes a dataset, reads it back, and says what belongs to it.

A new format is a subclass of ``Format`` in a file of its own and a line in ``registry.py``. It is imported wherever
formats are listed, so heavy libraries are imported in the methods that need them.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import pyarrow as pa
from pydantic import BaseModel

from pipeline.episode_schema import SCHEMA, GripperSpec
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.formats.episodes import Episodes, Load, Piece
from pipeline.formats.read_back import Copy, Fault, Written
from pipeline.identity import Step
from pipeline.types import Extra

Row = Mapping[str, Any]
"""A row of the manifest."""

Options = TypeVar("Options", bound=BaseModel)


@dataclass(frozen=True)
class Export:
    """The record of a finished dataset, in ``data/<run>/<format>.json``.

    Attributes:
        identity: digest of everything that the dataset's bytes depend on.
        asked: of that, what was asked for: the episodes and the options.
        made_with: and the rest, in words.
        files: all files below the format's folder, each with its SHA-256.
        places: episode id to the format's columns of the manifest.
    """

    identity: str
    files: Mapping[str, str]
    places: Mapping[str, Mapping[str, Any]]
    asked: str = ""
    made_with: Mapping[str, str] = field(default_factory=dict)


class Format(ABC, Generic[Options]):
    """A format's dataset of one run.

    Args:
        extras: what the episodes have beside the frames.
    """

    name: ClassVar[Step]
    """In the configuration's section ``export``, of the folder and the record in ``data/<run>``, on the command line,
    and in ``pipeline/identity.py``."""
    title: ClassVar[str]
    """For people, and the hub's tag."""
    columns: ClassVar[tuple[pa.Field, ...]]
    """Of the manifest: where an episode lies; null when it was dropped."""
    keys: Mapping[str, str]
    """Each view, ``state``, ``joint_state`` and ``action`` to its name in this format; each view's matrices and maps,
    such as ``image_depth``; and ``provenance`` to where that of an episode lies, with its matrices and instances."""
    clients: tuple[str, ...]
    """The clients of ``finetune.yaml`` that train on this format."""
    gripper: GripperSpec = SCHEMA.action.gripper
    """The commands of the gripper in this format."""

    def __init__(self, data: Path, options: Options, extras: Sequence[Extra] = ()) -> None:
        self.data = data
        self.options = options
        self.extras = tuple(extras)

    @property
    def folder(self) -> Path:
        """Holds the format's datasets and nothing else."""
        return self.data / self.name

    @property
    def root(self) -> Path:
        """What a client opens."""
        return self.folder

    @property
    def language(self) -> bool:
        """Whether it takes an episode's rewrites and subtasks."""
        return False

    @property
    def record_file(self) -> Path:
        return self.data / f"{self.name}.json"

    @property
    def stage_record(self) -> Path:
        """The record that DVC knows the output of the format's stage by."""
        data = self.data.parent if "outcome" in self.extras else self.data  # Failures are written by the same stage.
        return data / f"{self.name}.json"

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
            raise PipelineError(f"no finished dataset ({error})", where=self.record_file, remedy=MAKE_AGAIN) from error

    def written(self) -> list[Written]:
        """The files of the finished dataset.

        Raises:
            PipelineError: when there is none.
        """
        return [Written(self.name, self.folder / name, sha256) for name, sha256 in self.record().files.items()]

    # Writing: pieces in parallel, each whole or not there, then what joins them.

    @abstractmethod
    def pieces(self, episodes: Episodes) -> list[Piece]:
        """What each worker writes. Pieces below ``dataset/`` already lie where the finished dataset has them."""

    def sets(self, pieces: Sequence[Piece]) -> set[str]:
        """Names of the datasets that come of these pieces, each a folder of ``folder``."""
        return {Path(piece.path).parts[1] for piece in pieces}

    @abstractmethod
    def write_piece(self, path: Path, piece: Piece, load: Load) -> None:
        """Write a file or a folder, in a worker; one episode at a time is in memory.

        Raises:
            PipelineError: when an episode breaks the schema.
        """

    @abstractmethod
    def assemble(self, work: Path, pieces: Sequence[Piece]) -> dict[str, dict[str, Any]]:
        """Finish ``work/dataset``, which becomes ``folder``, from the pieces.

        Returns:
            Episode id to the values of ``columns``.
        """

    # Reading back, as clients do.

    @abstractmethod
    def open(self) -> None:
        """Read what the dataset says of itself, as far as its episodes are found by that.

        Raises:
            PipelineError: when it cannot be read.
        """

    @abstractmethod
    def check(self, kept: Mapping[str, Row], cache: Path) -> Iterator[tuple[str, Fault]]:
        """List what is off with the dataset as a whole, each with the check's name: ``format``, ``ids``, ``splits`` or
        ``readable``.

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

    def repository_folders(self) -> set[str]:
        """The top folders of a repository that are the dataset's alone, whatever options it was written with."""
        return {self.name}

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
            kept: the manifest's rows of its episodes.
        """
