"""Rebuilding of one episode from its row of the manifest and the demonstration, and comparison with the dataset.

`python -m pipeline dataset regenerate EPISODE_ID CONFIG --out FOLDER`
"""

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline import gl
from pipeline.compute.pool import loop
from pipeline.config import DemosConfig
from pipeline.errors import PipelineError
from pipeline.files import remove
from pipeline.formats.base import ManifestRow
from pipeline.formats.episodes import EpisodeFacts, Episodes
from pipeline.formats.rlds import Rlds, RldsConfig
from pipeline.formats.tfrecord import METADATA, columns, info_of, record_at
from pipeline.identity import version_column, versions
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.run import manifest
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.export import export
from pipeline.run.layout import FRAMES, PLAN, TRAJECTORIES
from pipeline.run.render_job import RenderJob
from pipeline.run.replay_job import ReplayJob
from pipeline.stores.frame_store import FrameStore, frames_by_trajectory
from pipeline.types import Verdict


def regenerate(episode_id: str, manifest_file: Path, out: Path, root: Path | None = None) -> dict[str, Any]:
    """Replay, render and serialise one kept episode again, and compare it with the dataset next to the manifest.

    Args:
        manifest_file: manifest of the run; the ``rlds`` folder is expected next to it.
        out: a new folder for the replay, the frames, and the episode as an RLDS set of its own.
        root: folder of LIBERO's HDF5 demonstrations, if the run started from them.

    Returns:
        JSON-serialisable: ``identical`` (`None` without a dataset) and ``reason`` (``kept``, or why the replay or the
        rendering was rejected this time). ``versions`` and ``gl_device`` list differences between the manifest and
        this machine. ``differs`` maps columns to the steps or values that differ. This project's own version, which
        the dataset also stores, is not compared.

    Raises:
        PipelineError: when the manifest has no such kept episode, or its demonstration is missing or has changed.
    """
    rows = {row["episode_id"]: row for row in manifest.read(manifest_file)}
    row = rows.get(episode_id)
    if row is None or not row["kept"]:
        what = (
            f"there is no kept episode {episode_id!r}" if row is None else f"{episode_id} was dropped: {row['reason']}"
        )
        raise PipelineError(what, where=manifest_file, expected="an episode_id whose row has kept = true")
    if out.exists() and any(out.iterdir()):
        raise PipelineError("the folder is not empty", where=out, remedy="name a new folder with --out")
    device = gl.choose().device
    try:
        rebuilt, reason = _rebuild(row, rows[row["twin_id"]], manifest.settings(manifest_file), out, root)
    except BaseException:
        # A stopped call leaves none of its files, so that it can be repeated.
        for name in (PLAN, TRAJECTORIES, FRAMES, Rlds.name, f"{Rlds.name}.json"):
            remove(out / name)
        raise
    dataset = next(manifest_file.parent.glob(f"rlds/*/*/{row['rlds_shard']}"), None)
    stored = None if dataset is None else _record(dataset, row["rlds_index"])
    differs = _differences(stored[1], rebuilt[1]) if stored and rebuilt else {}
    other_version = differs.pop(METADATA + manifest.OWN_VERSION, None) is not None
    identical: bool | None = None
    if stored:
        identical = rebuilt is not None and (rebuilt[0] == stored[0] or (other_version and not differs))
    other_versions = {}
    for name, here in versions().items():
        recorded = row[version_column(name)]
        if recorded != here:
            other_versions[name] = {"manifest": recorded, "here": here}
    return {
        "episode_id": episode_id,
        "identical": identical,
        "reason": reason,
        "versions": other_versions,
        "gl_device": {} if row["gl_device"] == device else {"manifest": row["gl_device"], "here": device},
        "differs": differs,
    }


_Record = tuple[bytes, dict[str, NDArray[Any]]]


def _record(shard: Path, index: int) -> _Record:
    """Read an episode of a shard: the serialised example, and its columns."""
    data = record_at(shard, index)
    if data is None:
        raise PipelineError(
            f"the shard has no record {index}", where=shard, expected="the records that the manifest names"
        )
    return data, columns(data, info_of(shard.parent).features)


def _plan_row(row: ManifestRow) -> plan.Row:
    return plan.Row(**{column.name: row[column.name] for column in fields(plan.Row)})


def _rebuild(
    row: ManifestRow, twin: ManifestRow, settings: manifest.Settings, out: Path, root: Path | None
) -> tuple[_Record | None, str]:
    """Generate the episode again below ``out``; return `None` and the reason if it is not kept this time."""
    if (settings.source == "hdf5") != (root is not None):
        raise PipelineError(
            f"the run's demonstrations have the source {settings.source}",
            where="--demos",
            expected="the folder with <suite>/<task>_demo.hdf5 for hdf5, nothing for starter",
        )
    demos = DemosConfig(source=settings.source, root=root)
    if demos.open().load(row["demo_id"]).sha256 != row["demo_sha256"]:
        raise PipelineError(
            "the demonstration is not the one that the episode was generated from",
            where=row["demo_id"],
            expected=f"content with the hash {row['demo_sha256']}",
            remedy="use the publisher's file of the demonstration; for a task of the publisher's own, also the BDDL "
            "file, which is part of this hash",
        )
    trajectories, frames = out / TRAJECTORIES, out / FRAMES
    planned, planned_twin = _plan_row(row), _plan_row(twin)
    plan.write([planned], out / PLAN)

    def replay(each: plan.Row) -> Verdict:
        return ReplayJob(each, planned_twin.trajectory_id, demos, settings.replay, trajectories)()

    if settings.replay.mode != "open_loop" and planned_twin.trajectory_id != planned.trajectory_id:
        # Tracking follows the clean twin's trajectory.
        replay(planned_twin)
    verdict = replay(planned)
    if not verdict.kept:
        return None, verdict.reason
    content = settings.render.content
    streams = tuple(streams_of(planned.perturbations, content.views).values())
    RenderJob(planned, streams, trajectories, frames, settings.render, gl.choose().device)()
    rejected = frames_by_trajectory(FrameStore(frames, settings.render).rows())[planned.trajectory_id].rejected
    if rejected:
        return None, next(iter(rejected.values()))
    load = EpisodeLoader(out, settings.render, rewrites={row["episode_id"]: json.loads(row["rewrites"])})
    rebuilt = Rlds(out, RldsConfig(name="regenerated", shards=1), content)
    export(rebuilt, Episodes({row["episode_id"]: EpisodeFacts(row["suite"])}, load), loop)
    (shard,) = rebuilt.folder.rglob("*.tfrecord-*")
    return _record(shard, 0), "kept"


def _differences(stored: Mapping[str, NDArray[Any]], rebuilt: Mapping[str, NDArray[Any]]) -> dict[str, str]:
    differences = {}
    for name in sorted({*stored, *rebuilt}):
        if name not in stored or name not in rebuilt:
            differences[name] = "only in the dataset" if name in stored else "only in the rebuilt episode"
            continue
        there, here = stored[name], rebuilt[name]
        off = [step for step, pair in enumerate(zip(there, here, strict=False)) if not np.array_equal(*pair)]
        if len(there) != len(here):
            differences[name] = f"{len(there)} steps in the dataset, {len(here)} rebuilt"
        elif off and not name.startswith(METADATA):
            differences[name] = f"{len(off)} of {len(here)} steps, the first at step {off[0]}"
        elif off and isinstance(there[0], bytes):
            differences[name] = f"{there[0].decode()!r} in the dataset, {here[0].decode()!r} rebuilt"
        elif off:
            differences[name] = "other numbers"
    return differences
