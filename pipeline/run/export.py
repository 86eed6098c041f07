"""Bring a dataset up to date: what is finished stays, what a killed run had finished of it stays too.

Pieces are written into ``data/<run>/.work/<format>/<identity>/``, each under a temporary name that is renamed once it
is whole. The finished dataset then takes the place of the one before in one rename, and the work folder goes.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pipeline.compute.pool import Run, runner
from pipeline.config import Config
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.files import checksum, keep_below, keep_only, put_in_place, remove, remove_if_empty, replaced, sync
from pipeline.formats.base import Export, Format
from pipeline.formats.episodes import Episodes, Known, Load, Piece
from pipeline.identity import PACKAGES, RECIPES, differences, made_with, refuse_unasked
from pipeline.run import outcome
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.seeding import digest

AnyFormat = Format[Any]


def export_run(target: Format[Any], config: Config) -> None:
    """Bring a run's dataset up to date, and say what was done."""
    episodes = kept_episodes(config)
    if is_current(target, episodes):
        print(f"{target.folder} has these {len(episodes.ids)} episodes already, see {target.record_file}")
        return
    refuse_unasked(outdated(target, episodes), target.folder)
    with runner(config.compute, config.data) as workers:
        export(target, episodes, workers)
    print(f"wrote {len(episodes.ids)} episodes to {target.folder}")


def kept_episodes(config: Config) -> Episodes:
    """The kept episodes of a run, in the order they are written."""
    run = outcome.read(config)
    rows, contents = {row.episode_id: row for row in run.rows}, run.contents()
    known = {}
    for episode_id in run.kept:
        row = rows[episode_id]
        steps = run.trajectories[row.trajectory_id]["steps"]
        known[episode_id] = Known(row.suite, contents[episode_id], row.demo_id, row.instruction, steps)
    return Episodes(known, EpisodeLoader(config.data / "plan.parquet", config.data / "frames", config.render))


def identity(target: AnyFormat, episodes: Episodes) -> str:
    """A short digest of everything that the bytes of a dataset depend on."""
    return digest(
        "export",
        target.name,
        RECIPES[target.name],
        {package: version(package) for package in PACKAGES[target.name]},
        SCHEMA.model_dump(mode="json"),
        target.options.model_dump(mode="json"),
        target.extras,
        [[piece.path, piece.ids] for piece in target.pieces(episodes)],
        [known.content for known in episodes.known.values()],
    )[:16]


def asked(target: AnyFormat, episodes: Episodes) -> str:
    """A short digest of what of it was asked for: the episodes with all that they are, and the options."""
    content = [known.content for known in episodes.known.values()]
    return digest(target.options.model_dump(mode="json"), target.extras, content)[:16]


def outdated(target: AnyFormat, episodes: Episodes) -> Counter[str]:
    """Why the finished dataset would be made anew although the same was asked for, to its number of files."""
    try:
        record = target.record()
    except PipelineError:
        return Counter()
    if record.asked != asked(target, episodes) or record.identity == identity(target, episodes):
        return Counter()
    return Counter({f"files, made with {differences(record.made_with, _made_with(target))}": len(record.files)})


def _made_with(target: AnyFormat) -> dict[str, str]:
    return {**made_with(target.name), "episode schema": digest(SCHEMA.model_dump(mode="json"))[:8]}


def is_current(target: AnyFormat, episodes: Episodes) -> bool:
    """Whether the dataset is there, whole and of these episodes.

    Every file must be there and no younger than the record. What else lies in the folder, such as the statistics that
    a client left, is removed then.
    """
    if not untouched(target) or target.record().identity != identity(target, episodes):
        return False
    keep_below(target.folder, {target.folder / name for name in target.record().files})
    _clear_work(target)
    return True


def untouched(target: AnyFormat) -> bool:
    """Whether all files of a finished dataset are there, and none has changed since it was recorded."""
    try:
        recorded = target.record_file.stat().st_mtime_ns
        return all((target.folder / name).stat().st_mtime_ns <= recorded for name in target.record().files)
    except (PipelineError, OSError):
        return False


def settle(target: AnyFormat) -> None:
    """Where files of a finished dataset are gone or have changed, have it count as not there."""
    if not target.record_file.exists() or untouched(target):
        return
    try:
        same = all(checksum(target.folder / name) == sha256 for name, sha256 in target.record().files.items())
    except (PipelineError, OSError):
        same = False
    if same:  # Such as in a copy.
        target.record_file.touch()
    else:
        target.record_file.unlink()
        target.stage_record.unlink(missing_ok=True)


def export(target: AnyFormat, episodes: Episodes, run: Run) -> None:
    """Write a dataset, replacing the one before, and go on where a killed call with the same episodes was.

    The bytes depend on the episodes, their order, the options and the format's packages alone: not on ``run``, and not
    on how often the work was interrupted.

    Args:
        target: the format.
        episodes: what to write.
        run: spreads the work; one call for each piece.

    Raises:
        PipelineError: when an episode breaks the schema or the ids are unfit. The dataset before stays; the pieces that
            are whole stay in the work folder.
    """
    pieces = target.pieces(episodes)
    work = target.work / identity(target, episodes)
    keep_only(target.work, {work.name})
    finished = work / "record.json"
    if not finished.is_file():
        _write_pieces(target, work, pieces, episodes.load, run)
        # In a worker, which has the format's packages loaded already.
        (places,) = run(_Assembly(target, work), [pieces], f"{target.title} assembly")
        dataset = work / "dataset"
        sync(dataset)
        paths = sorted(file for file in dataset.rglob("*") if file.is_file())
        checksums = run(checksum, paths, f"{target.title} checksums")
        files = {path.relative_to(dataset).as_posix(): sha256 for path, sha256 in zip(paths, checksums, strict=True)}
        with replaced(finished) as temporary:
            record = Export(work.name, files, places, asked(target, episodes), _made_with(target))
            temporary.write_text(json.dumps(asdict(record), indent=0) + "\n")
    target.record_file.unlink(missing_ok=True)  # It is about the dataset before.
    if (work / "dataset").is_dir():
        put_in_place(work / "dataset", target.folder)
    finished.touch()  # No file of the dataset is younger than its record.
    put_in_place(finished, target.record_file)
    _clear_work(target)


def _write_pieces(target: AnyFormat, work: Path, pieces: Sequence[Piece], load: Load, run: Run) -> None:
    paths = {work / piece.path: piece for piece in pieces}
    whole = {path for path in paths if path.exists()}
    keep_below(work, whole)
    for folder in {path.parent for path in paths}:
        folder.mkdir(parents=True, exist_ok=True)
    todo = [(path, piece) for path, piece in paths.items() if path not in whole]
    run(_PieceJob(target, load), todo, f"{target.title} pieces")


@dataclass(frozen=True)
class _PieceJob:
    target: AnyFormat
    load: Load

    def __call__(self, todo: tuple[Path, Piece]) -> None:
        path, piece = todo
        with replaced(path) as temporary:
            self.target.write_piece(temporary, piece, self.load)


@dataclass(frozen=True)
class _Assembly:
    target: AnyFormat
    work: Path

    def __call__(self, pieces: Sequence[Piece]) -> dict[str, dict[str, Any]]:
        # Without what a worker made that was lost in the middle of it.
        keep_below(self.work, {self.work / piece.path for piece in pieces})
        return self.target.assemble(self.work, pieces)


def _clear_work(target: AnyFormat) -> None:
    remove(target.work)
    remove_if_empty(target.work.parent)
