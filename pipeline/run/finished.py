"""Records of stages with few outputs: skip a stage if its inputs and recipe have not changed since its last call.

The record of a stage is the file ``data/<run>/.finished/<stage>.json``. A stage works again if one of its outputs is
deleted; for a dataset, delete its record, too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pipeline.axes.language import BANK_FILE
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.files import checksum, read_json, write_json
from pipeline.formats.registry import FORMATS
from pipeline.identity import LIBRARY, RECIPES, Step, digest_library, made_with, versions
from pipeline.record import Basis, Record
from pipeline.run.dataset_files import first_changed_file
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
class StageRecord:
    """Record of a stage's outputs in the run's folder, and the basis that the outputs have if the stage works now.

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

    def is_up_to_date(self) -> bool:
        """Return whether the outputs are unchanged, and were generated from the same inputs by the same recipe."""
        return self.reason_to_run() is None

    def reason_to_run(self) -> str | None:
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
        return record.describe_mismatch(self.basis)

    def write(self) -> None:
        """Write the record of the present outputs, with the basis from before the stage worked."""
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
        return _contents(self.outputs, self.data)


def missing_or_changed(file: Path, data: Path) -> str:
    """Describe the state of a file of a run's folder ``data`` that is not as it was recorded."""
    return f"{file.relative_to(data).as_posix()} {'has changed' if file.exists() else 'is missing'}"


def stage_record(
    run: Run, name: str, settings: Mapping[str, object], inputs: Sequence[str], outputs: Sequence[str]
) -> StageRecord:
    """Return the record of a stage whose outputs depend on this library, its settings and its input files.

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
        return StageRecord(run.folder, name, None, outputs, "a package is missing, or another copy of it is imported")
    made_with_all["code"] = digest_library()[:16]
    basis = Basis.of({"settings": dict(settings), "files": _contents(inputs, run.folder)}, made_with_all)
    return StageRecord(run.folder, name, basis, outputs)


def validate_record(run: Run) -> StageRecord:
    """Return the record of ``validate``, which passed on the recorded contents."""
    config, datasets = run.config, run.recorded_datasets
    records = [dataset.record_file.relative_to(run.folder).as_posix() for dataset in datasets]
    return _record_of(
        run,
        "validate",
        "checks",
        changed_file=run.trajectories.changed_file() or run.frames.changed_file() or first_changed_file(datasets),
        settings={
            "render": settings_of(config.render),
            "export": settings_of(config.export),
            "axes": settings_of(config.plan.axes),
            "bank of rewrites": checksum(BANK_FILE),
        },
        inputs=[PLAN, MANIFEST, COUNTS, STATISTICS, INPUTS, TRAJECTORIES_TABLE, FRAMES_TABLE, *records],
        outputs=[VALIDATION],
    )


def trial_record(run: Run, device: str) -> StageRecord:
    """Return the record of a trial of this machine."""
    basis = Basis.of({"host": host()}, {**made_with("pixels"), "OpenGL device": device})
    return StageRecord(run.folder, "trial", basis, [MACHINE])


def summary_record(run: Run) -> StageRecord:
    """Return the record of the contact sheets and previews."""
    return _record_of(
        run,
        "summary",
        "pictures",
        changed_file=run.frames.changed_file(),
        settings=_settings_of_pictures(run.config),
        inputs=[PLAN, MANIFEST, INPUTS, FRAMES_TABLE],
        outputs=[SHEETS, PREVIEWS],
    )


def previews_record(run: Run) -> StageRecord:
    """Return the record of the previews, which show no episode and do not depend on kept or exported episodes."""
    return _record_of(
        run,
        "previews",
        "pictures",
        changed_file=None,
        settings=_settings_of_pictures(run.config),
        inputs=[INPUTS],
        outputs=[PREVIEWS],
    )


def report_record(run: Run) -> StageRecord:
    """Return the record of the report."""
    return _record_of(
        run,
        "report",
        "pictures",
        changed_file=run.frames.changed_file(),
        settings={
            **settings_of(run.config, {"compute", "folder", "publish"}),
            "measures of the test tasks": checksum(SEEN),
        },
        inputs=[PLAN, MANIFEST, LEAKAGE, INPUTS, FRAMES_TABLE, SHEETS, PREVIEWS],
        outputs=[REPORT],
    )


def _record_of(
    run: Run,
    stage: str,
    step: Step,
    *,
    changed_file: Path | None,
    settings: Mapping[str, object],
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> StageRecord:
    """Return the record of a stage whose outputs depend on one step, its settings and its input files.

    Args:
        step: step of ``pipeline/identity.py``.
        changed_file: a stored file that was changed or deleted; the outputs are then not up to date.
        settings: JSON-serialisable.
        inputs: files and folders of the run.
        outputs: files and folders of the run.
    """
    if changed_file is not None:
        return StageRecord(run.folder, stage, None, outputs, missing_or_changed(changed_file, run.folder))
    requested = {"settings": settings, "files": _contents(inputs, run.folder)}
    return StageRecord(run.folder, stage, Basis.of(requested, made_with(step)), outputs)


def _settings_of_pictures(config: Config) -> dict[str, object]:
    settings: dict[str, object] = {
        "demos": settings_of(config.demos),
        "plan": settings_of(config.plan),
        "replay": settings_of(config.replay),
    }
    if config.render.views:  # Without further views, pictures of earlier versions stay up to date.
        settings["views"] = [*config.render.views]
    return settings


def _contents(names: Sequence[str], data: Path) -> Mapping[str, str]:
    """Map each existing file of ``data`` to its SHA-256.

    Args:
        names: files of ``data``, and folders whose files are all listed.
    """
    contents: dict[str, str] = {}
    for name in names:
        for file in _files(data / name):
            if file.exists():
                contents[file.relative_to(data).as_posix()] = checksum(file)
    return contents


def _files(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
