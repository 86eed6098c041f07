"""A stage whose outputs are few remembers what it made them from: where that is the same again, it does nothing.

The memory is a file of ``data/<run>/.finished/``. To have a stage work again, delete its output.
"""

import json
import platform
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from pydantic import BaseModel

from pipeline.axes.language import BANK_FILE
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.files import checksum, read_json, write_json
from pipeline.formats.registry import recorded
from pipeline.identity import fingerprint
from pipeline.run.export import untouched
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.store import TABLE
from pipeline.stores.trajectory_store import TrajectoryStore

FOLDER = ".finished"
FRAMES = f"frames/{TABLE}"
SEEN = Path(__file__).parents[1] / "testset" / "seen.json"
"""What a policy sees in test tasks, which the report shows beside what it sees in the run."""


@dataclass(frozen=True)
class Memory:
    """What a stage's outputs were made from.

    Attributes:
        made_by: the fingerprint of its inputs and recipe; None where an input has changed since it was recorded.
        outputs: files or folders of ``data``.
    """

    data: Path
    stage: str
    made_by: str | None
    outputs: Sequence[str]

    def holds(self) -> bool:
        """Whether the outputs are there as they were made, from the same inputs by the same recipe."""
        try:
            return self.made_by is not None and read_json(self._file) == self._now()
        except (PipelineError, OSError):
            return False

    def keep(self) -> None:
        """Remember the outputs as they are."""
        self._file.unlink(missing_ok=True)
        if self.made_by is not None:
            write_json(self._file, self._now())

    @property
    def _file(self) -> Path:
        return self.data / FOLDER / f"{self.stage}.json"

    def _now(self) -> dict[str, Any]:
        return {"made_by": self.made_by, "outputs": _contents([self.data / name for name in self.outputs], self.data)}


def of_validate(config: Config) -> Memory:
    """Of what ``validate`` found: it passed on these contents, of which nothing has changed."""
    names = ("plan.parquet", "manifest.parquet", "counts.json", "dataset_statistics.json", "inputs.json")
    formats = recorded(config.data, config.export, config.render.extras)
    stores = (TrajectoryStore(config.data / "trajectories"), FrameStore(config.data / "frames", config.render))
    files = [config.data / name for name in names] + [store.root / TABLE for store in stores]
    files += [one.record_file for one in formats]
    whole = all(store.untouched() for store in stores) and all(untouched(one) for one in formats)
    sections = [settings_of(section) for section in (config.render, config.export, config.plan.axes)]
    settings = [*sections, checksum(BANK_FILE)]
    made_by = fingerprint("checks", *settings, _contents(files, config.data)) if whole else None
    return Memory(config.data, "validate", made_by, ["validation.json"])


def of_doctor(config: Config, device: str) -> Memory:
    """Of a trial of this machine."""
    return Memory(config.data, "doctor", fingerprint("pixels", device, *host()), ["machine.json"])


def host() -> list[list[str]]:
    """This machine's name and kernel, and the models of its processors."""
    cpu = Path("/proc/cpuinfo")
    models = {line for line in cpu.read_text().splitlines() if line.startswith("model name")} if cpu.exists() else {}
    return [list(platform.uname()), sorted(models)]


def of_summary(config: Config) -> Memory:
    """Of the contact sheets and previews."""
    names = ("plan.parquet", "manifest.parquet", "inputs.json", FRAMES)
    return _of_pictures(config, "summary", ["sheets", "previews"], _drawn_by(config), names)


def of_previews(config: Config) -> Memory:
    """Of the previews alone, which show no episode: what is kept and exported changes none."""
    return _of_pictures(config, "previews", ["previews"], _drawn_by(config), ["inputs.json"])


def of_report(config: Config) -> Memory:
    """Of the report."""
    names = ("plan.parquet", "manifest.parquet", "leakage.json", "inputs.json", FRAMES, "sheets", "previews")
    settings = [settings_of(config, {"compute", "folder", "publish"}), checksum(SEEN)]
    return _of_pictures(config, "report", ["report.html"], settings, names)


def _of_pictures(
    config: Config, stage: str, outputs: Sequence[str], settings: Sequence[object], names: Sequence[str]
) -> Memory:
    whole = FRAMES not in names or FrameStore(config.data / "frames", config.render).untouched()
    contents = _contents([config.data / name for name in names], config.data)
    return Memory(config.data, stage, fingerprint("pictures", *settings, contents) if whole else None, outputs)


def _drawn_by(config: Config) -> list[dict[str, Any]]:
    return [settings_of(section) for section in (config.demos, config.plan, config.replay)]


def _contents(paths: Sequence[Path], data: Path) -> Mapping[str, str]:
    files = (file for path in paths for file in _files(path) if file.exists())
    return {file.relative_to(data).as_posix(): checksum(file) for file in files}


def settings_of(section: BaseModel, but: Set[str] = frozenset()) -> dict[str, Any]:
    """JSON-serialisable; of a path the name alone, as ``inputs.json`` tells what lies there."""
    # By the names that the fields had when they were first written.
    dumped = section.model_dump(exclude=set(but), by_alias=True)
    listed: dict[str, Any] = json.loads(json.dumps(dumped, default=lambda path: PurePath(path).name))
    return listed


def _files(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
