"""Interface of an output format: an object that writes a dataset, reads it back, and describes its contents.

A new format is a subclass of ``Format`` in a file of its own and a line in ``registry.py``. Reading a configuration
imports it, so methods import the heavy libraries that they need.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Generic, NamedTuple, TypeVar

import pyarrow as pa
from pydantic import AfterValidator, Field

from pipeline.episode_schema import SCHEMA, STANDARD, Content, GripperSpec
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.formats.episodes import Episodes, Load, Piece
from pipeline.formats.read_back import Copy, Fault, Written
from pipeline.identity import made_with_recipe
from pipeline.record import Basis, Record
from pipeline.types import LONGEST_NAME, Frozen

ManifestRow = Mapping[str, Any]
"""A row of the manifest."""


def _of_some(share: float) -> float:
    if 0 < share < 0.001:
        raise ValueError("expected 0, or 0.001 to 0.5")
    return share


ValidationShare = Annotated[float, Field(ge=0.0, le=0.5), AfterValidator(_of_some)]

Name = Annotated[str, Field(pattern=r"^([a-z][a-z0-9_]*)?$", max_length=LONGEST_NAME)]
"""Name of a dataset; ``Config`` replaces an empty name by ``libero_`` and the name of the run."""


class FormatOptions(Frozen):
    """Options of every format, and base class of a format's own options.

    The identity of a finished dataset depends on their serialization, aliases included: a field that is added later is
    excluded at its default.

    Attributes:
        name: Name of the dataset, or first part of the names of its sets; ``libero_`` and the name of the run by
            default.
        validation: Share of each task's demonstrations in the split ``val``, 0 or 0.001 to 0.5; 0 by default. A format
            declares the field after its own fields.
    """

    name: Name = ""
    if TYPE_CHECKING:
        validation: ValidationShare = 0.0

    def reject_name(self) -> None:
        """Reject a name under which a client would misread the dataset.

        Raises:
            ValueError: naming the client.
        """

    def reject_content(self, content: Content) -> None:
        """Reject options that do not fit the content of the run's episodes.

        Raises:
            ValueError: naming the option.
        """


Options = TypeVar("Options", bound=FormatOptions)


@dataclass(frozen=True)
class DatasetRecord(Record):
    """The record of a finished dataset, in ``data/<run>/<format>.json``.

    Attributes:
        places: episode id to the format's columns of the manifest.
        sizes: path of each file to its size in bytes; empty in records of earlier versions.
    """

    places: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    sizes: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "DatasetRecord":
        """Return the record that ``to_json`` wrote, in this version or an earlier one.

        Raises:
            LookupError, TypeError, ValueError: when the content is not such a record.
        """
        basis = Basis(content["identity"], content.get("asked", ""), content.get("made_with", {}))
        return cls(basis, dict(content["files"]), content["places"], content.get("sizes", {}))

    def to_json(self) -> dict[str, Any]:
        """Return the content of the file."""
        return {
            "identity": self.basis.identity,
            "files": self.files,
            "places": self.places,
            "asked": self.basis.requested,
            "made_with": self.basis.made_with,
            "sizes": self.sizes,
        }


class StepSizes(NamedTuple):
    """Sizes of the parts of one step of an episode, in KB.

    Attributes:
        frame_kb: one frame of one view.
        maps_kb: depth and segmentation of one view, as far as they are stored.
        poses_kb: object poses and boxes, as far as they are stored.
        motion_kb: state, action and all other columns except the frames.
    """

    frame_kb: float
    maps_kb: float
    poses_kb: float
    motion_kb: float


@dataclass(frozen=True)
class CardFacts:
    """Facts about the storage of a dataset for its card.

    Attributes:
        held_out_place: end of the card's sentence on the episodes for validation, in Markdown.
        turns_frames: true if frames are rotated by 180 degrees from LIBERO's raw frames, as in an ``Episode``.
        maps_stored_as: form of depth and segmentation, in words.
        flattens_matrices: true if matrices are stored row by row, without their shape.
        has_language_column: true if every frame has lerobot's language column.
        has_depth_video: true if depth is a video in lerobot's own codes.
    """

    held_out_place: str
    turns_frames: bool = True
    maps_stored_as: str = "PNG"
    flattens_matrices: bool = False
    has_language_column: bool = False
    has_depth_video: bool = False


class Format(ABC, Generic[Options]):
    """A format's dataset of one run.

    Args:
        content: content of the episodes.
    """

    name: ClassVar[str]
    """Name in the configuration's section ``export``, on the command line and of the recipe, and of the folder and the
    record in ``data/<run>``."""
    title: ClassVar[str]
    """Name for people, and the hub's tag."""
    options_type: ClassVar[type[FormatOptions]]
    """Model of its options, which are a field of the section ``export`` under the format's name."""
    by_default: ClassVar[bool] = False
    """True if a run writes the format unless its configuration has ``null``."""
    recipe: ClassVar[int]
    """Recipe number (see ``pipeline/identity.py``); 1 for a new format."""
    packages: ClassVar[tuple[str, ...]]
    """Packages that compute the bytes of the files."""
    group: ClassVar[str]
    """Name of the format that is written by the same stage, ``export_<group>``; most often the format's own name."""
    stores_replay: ClassVar[bool] = False
    """True if the format stores the states and the scene of each episode's replay."""
    splits_each_suite: ClassVar[bool] = False
    """True if a client that validates needs the split ``val`` of every suite, instead of one of all suites."""
    step_s: float
    """CPU time of one core to write one step of an episode, in s, on the reference machine of ``work_time.py``."""
    validate_s: float = 0.0006
    """CPU time of one core to read back and check one step of an episode, in s, on the same machine."""
    columns: ClassVar[tuple[pa.Field, ...]]
    """Columns of the manifest with the place of an episode; null when it was dropped."""
    keys: Mapping[str, str]
    """Names in this format of each view, of ``state``, ``joint_state`` and ``action``, and of each view's matrices and
    maps, such as ``image_depth``. ``provenance`` is the place of an episode's provenance, matrices and instances;
    ``labels`` is the place of its subtasks and rewrites."""
    clients: tuple[str, ...]
    """The clients of ``finetune.yaml`` that train on this format."""
    gripper: GripperSpec = SCHEMA.action.gripper
    """The commands of the gripper in this format."""
    card_facts: CardFacts
    """Facts about the storage, for the dataset card."""

    def __init__(self, data: Path, options: Options, content: Content = STANDARD) -> None:
        self.data = data
        self.options = options
        self.content = content

    @classmethod
    def made_with(cls) -> dict[str, str]:
        """Map names for people to the recipe, the package versions and the machine code of the files."""
        return made_with_recipe(cls.name, cls.recipe, cls.packages)

    @property
    def folder(self) -> Path:
        """Return the folder of the format's datasets; it contains nothing else."""
        return self.data / self.name

    @property
    def root(self) -> Path:
        """Return the folder that a client opens."""
        return self.folder

    @property
    def record_file(self) -> Path:
        return self.data / f"{self.name}.json"

    @property
    def work(self) -> Path:
        """Return the folder of unfinished files, on the file system of ``folder``, so that finishing only renames."""
        return self.data / ".work" / self.name

    def record(self) -> DatasetRecord:
        """Read the record of the finished dataset.

        Raises:
            PipelineError: when the record is missing or unreadable.
        """
        try:
            return DatasetRecord.from_json(json.loads(self.record_file.read_text()))
        except (OSError, LookupError, TypeError, ValueError) as error:
            raise PipelineError(
                f"there is no finished dataset ({error})", where=self.record_file, remedy=MAKE_AGAIN
            ) from error

    def written(self) -> list[Written]:
        """List the files of the finished dataset.

        Raises:
            PipelineError: as ``record``.
        """
        return [Written(self.name, self.folder / name, sha256) for name, sha256 in self.record().files.items()]

    @abstractmethod
    def step_kb(self, sizes: StepSizes) -> float:
        """Estimate the size of one step of an episode in this format, in KB."""

    # Writing: pieces in parallel, each complete or absent, then the files that join them.

    @abstractmethod
    def pieces(self, episodes: Episodes) -> list[Piece]:
        """Divide the episodes into the pieces that workers write.

        Pieces below ``dataset/`` are already in their place in the finished dataset.
        """

    def sets(self, pieces: Sequence[Piece]) -> set[str]:
        """Return the names of the datasets that these pieces form, each a folder below ``folder``."""
        return {Path(piece.path).parts[1] for piece in pieces}

    @abstractmethod
    def write_piece(self, path: Path, piece: Piece, load: Load) -> None:
        """Write a piece, a file or a folder, in a worker, with one episode at a time in memory.

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
        """Read the metadata by which the dataset's episodes are found.

        Raises:
            PipelineError: when it cannot be read.
        """

    @abstractmethod
    def check(self, kept: Mapping[str, ManifestRow], cache: Path) -> Iterator[tuple[str, Fault]]:
        """List the faults of the dataset as a whole.

        Each fault comes with the name of its check: ``format``, ``ids``, ``splits`` or ``readable``.

        Args:
            kept: episode id to its row of the manifest.
            cache: a folder for files that reading needs.

        Raises:
            PipelineError: when the dataset cannot be opened.
        """

    @abstractmethod
    def read(self, row: ManifestRow) -> Copy | None:
        """Read an episode, wherever the dataset has it; ``None`` when the dataset does not have it.

        Raises:
            PipelineError: when it cannot be read.
        """

    # Publishing.

    def repository_path(self, file: str) -> str:
        """Return the path in a repository of a file of ``record().files``."""
        return f"{self.name}/{file}"

    def repository_folders(self) -> set[str]:
        """Return a repository's top folders that only this dataset uses, whatever options it was written with."""
        return {self.name}

    def tag(self) -> str | None:
        """Return the tag for the commit of an upload, or ``None`` if no client needs a tag."""
        return None

    def viewer(self) -> list[dict[str, str]]:
        """Return the tables that the hub's viewer shows in addition to the manifest."""
        return []

    @abstractmethod
    def loading(self, name: str, repository: str, kept: Sequence[ManifestRow]) -> str:
        """Return the card's section on loading the dataset, in Markdown.

        Args:
            name: name of the run's datasets.
            kept: the manifest's rows of its episodes.
        """


AnyFormat = Format[Any]
"""Dataset of any format."""
