"""Memory of stages with few outputs: skip a stage if its inputs and recipe have not changed since its last call.

The memory of a stage is the file ``data/<run>/.finished/<stage>.json``. A stage works again if one of its outputs is
deleted; for a dataset, delete its record, too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path

from pipeline.axes.language import BANK_FILE
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.files import checksum, read_json, write_json
from pipeline.formats.registry import FORMATS
from pipeline.identity import LIBRARY, RECIPES, Step, digest_library, made_with, versions
from pipeline.record import Basis, Record
from pipeline.run.dataset_files import changed_file
from pipeline.run.inputs import settings_of
from pipeline.run.layout import (
    COUNTS,
    FINISHED,
    FRAMES,
    INPUTS,
    LEAKAGE,
    MACHINE,
    MANIFEST,
    PLAN,
    PREVIEWS,
    REPORT,
    SHEETS,
    STATISTICS,
    TRAJECTORIES,
    VALIDATION,
)
from pipeline.run.machine import host
from pipeline.run.run import Run
from pipeline.stores.store import TABLE

TRAJECTORIES_TABLE, FRAMES_TABLE = f"{TRAJECTORIES}/{TABLE}", f"{FRAMES}/{TABLE}"
SEEN = LIBRARY / "testset" / "seen.json"
"""File of measures of the test tasks, which the report shows next to the measures of the run."""

NO_RECORD = "no record of an earlier call"
"""Reason of a stage that was never finished."""


@dataclass(frozen=True)
class Memory:
    """Place of the record of a stage's outputs.

    Attributes:
        data: folder of the run.
        stage: name of the stage.
        basis: everything that the outputs depend on now; `None` if it cannot be determined.
        outputs: files or folders of ``data``.
        fault: reason why the basis cannot be determined; empty if it can.
    """

    data: Path
    stage: str
    basis: Basis | None
    outputs: Sequence[str]
    fault: str = ""

    def holds(self) -> bool:
        """Return whether the outputs are unchanged, and were generated from the same inputs by the same recipe."""
        return self.why_not() is None

    def why_not(self) -> str | None:
        """Describe why the stage has to work; `None` if the outputs are up to date."""
        if self.basis is None:
            return self.fault
        try:
            record = self._read()
        except (PipelineError, OSError, LookupError, TypeError, ValueError):
            return NO_RECORD
        outputs = self._contents()
        if record.matches(self.basis) and record.files != outputs:
            changed = sorted(name for name, _ in record.files.items() ^ outputs.items())
            return missing_or_changed(self.data / changed[0], self.data)
        return record.why_not(self.basis)

    def keep(self) -> None:
        """Record the present outputs."""
        self._file.unlink(missing_ok=True)
        if self.basis is not None:
            write_json(self._file, asdict(Record(self.basis, self._contents())))

    @property
    def _file(self) -> Path:
        return self.data / FINISHED / f"{self.stage}.json"

    def _read(self) -> Record:
        content = read_json(self._file)
        return Record(Basis(**content["basis"]), dict(content["files"]))

    def _contents(self) -> Mapping[str, str]:
        return _contents([self.data / name for name in self.outputs], self.data)


def missing_or_changed(file: Path, data: Path) -> str:
    """Describe the state of a file of a run's folder ``data`` that is not as it was recorded."""
    return f"{file.relative_to(data).as_posix()} {'has changed' if file.exists() else 'is missing'}"


def stage_memory(
    run: Run, name: str, settings: Mapping[str, object], inputs: Sequence[str], outputs: Sequence[str]
) -> Memory:
    """Return the memory of a stage whose outputs depend on this library, its settings and its input files.

    Args:
        settings: JSON-serialisable.
        inputs: files and folders of the run.
        outputs: files and folders of the run.
    """
    try:
        # The manifest states versions, also of this project.
        made_with_all = dict(versions())
        for step in RECIPES:
            made_with_all.update(made_with(step))
        for kind in FORMATS:
            made_with_all.update(kind.made_with())
    except PipelineError:
        # The stage `doctor` reports the fault.
        return Memory(run.folder, name, None, outputs, "a package is missing, or another copy of it is imported")
    made_with_all["code"] = digest_library()[:16]
    contents = _contents([run.path(file) for file in inputs], run.folder)
    basis = Basis.of({"settings": dict(settings), "files": contents}, made_with_all)
    return Memory(run.folder, name, basis, outputs)


def validate_memory(run: Run) -> Memory:
    """Return the memory of ``validate``, which passed on the recorded contents."""
    stores, formats = (run.trajectories, run.frames), run.recorded_datasets
    files = [run.path(name) for name in (PLAN, MANIFEST, COUNTS, STATISTICS, INPUTS)]
    files += [store.root / TABLE for store in stores]
    files += [dataset.record_file for dataset in formats]
    changes = chain((store.changed_file() for store in stores), map(changed_file, formats))
    changed = next(filter(None, changes), None)
    config = run.config
    settings = {
        "render": settings_of(config.render),
        "export": settings_of(config.export),
        "axes": settings_of(config.plan.axes),
        "bank of rewrites": checksum(BANK_FILE),
    }
    requested = {"settings": settings, "files": _contents(files, run.folder)}
    return _memory(run, "validate", [VALIDATION], requested, "checks", changed)


def trial_memory(run: Run, device: str) -> Memory:
    """Return the memory of a trial of this machine."""
    basis = Basis.of({"host": host()}, {**made_with("pixels"), "OpenGL device": device})
    return Memory(run.folder, "trial", basis, [MACHINE])


def summary_memory(run: Run) -> Memory:
    """Return the memory of the contact sheets and previews."""
    names = (PLAN, MANIFEST, INPUTS, FRAMES_TABLE)
    return _pictures_memory(run, "summary", [SHEETS, PREVIEWS], _settings_of_pictures(run.config), names)


def previews_memory(run: Run) -> Memory:
    """Return the memory of the previews, which show no episode and do not depend on kept or exported episodes."""
    return _pictures_memory(run, "previews", [PREVIEWS], _settings_of_pictures(run.config), [INPUTS])


def report_memory(run: Run) -> Memory:
    """Return the memory of the report."""
    names = (PLAN, MANIFEST, LEAKAGE, INPUTS, FRAMES_TABLE, SHEETS, PREVIEWS)
    settings = {
        **settings_of(run.config, {"compute", "folder", "publish"}),
        "measures of the test tasks": checksum(SEEN),
    }
    return _pictures_memory(run, "report", [REPORT], settings, names)


def _pictures_memory(
    run: Run, stage: str, outputs: Sequence[str], settings: Mapping[str, object], names: Sequence[str]
) -> Memory:
    changed = run.frames.changed_file() if FRAMES_TABLE in names else None
    requested = {"settings": settings, "files": _contents([run.path(name) for name in names], run.folder)}
    return _memory(run, stage, outputs, requested, "pictures", changed)


def _memory(
    run: Run, stage: str, outputs: Sequence[str], requested: object, step: Step, changed: Path | None
) -> Memory:
    """Return a memory that does not hold if a stored file was changed or deleted.

    Args:
        requested: settings and input files that the outputs depend on, JSON-serialisable.
        step: step of ``pipeline/identity.py`` that the outputs depend on.
        changed: a stored file that was changed or deleted.
    """
    if changed is not None:
        return Memory(run.folder, stage, None, outputs, missing_or_changed(changed, run.folder))
    return Memory(run.folder, stage, Basis.of(requested, made_with(step)), outputs)


def _settings_of_pictures(config: Config) -> dict[str, object]:
    settings: dict[str, object] = {
        "demos": settings_of(config.demos),
        "plan": settings_of(config.plan),
        "replay": settings_of(config.replay),
    }
    if config.render.views:  # Without further views, pictures of earlier versions stay up to date.
        settings["views"] = [*config.render.views]
    return settings


def _contents(paths: Sequence[Path], data: Path) -> Mapping[str, str]:
    contents: dict[str, str] = {}
    for path in paths:
        for file in _files(path):
            if file.exists():
                contents[file.relative_to(data).as_posix()] = checksum(file)
    return contents


def _files(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
