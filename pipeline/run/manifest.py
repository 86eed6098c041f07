"""Manifest: one row for every planned episode, with the reason why it was dropped and its place in each dataset."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field, ValidationError

from pipeline.config import Config, RenderConfig, ReplayConfig
from pipeline.episode_schema import SCHEMA
from pipeline.errors import MAKE_AGAIN, RUN_AGAIN, PipelineError
from pipeline.export_config import Where
from pipeline.identity import DISTRIBUTION, VERSIONS, version_column, versions
from pipeline.libero.tasks import exceeds_step_limit
from pipeline.planning import plan
from pipeline.planning.selection import NOT_NEEDED
from pipeline.run.outcome import Outcome, is_selected
from pipeline.tables import column, columns_of, read_table, write_table
from pipeline.types import Frozen, Quality

OWN_VERSION = "pipeline_version"
"""Column for the version of this project, for information only: recipe numbers decide which files are up to date."""

_SETTINGS = b"settings"


@dataclass(frozen=True)
class Result:
    """Result of a planned episode: the columns after the columns of the plan, with their meanings."""

    kept: Annotated[bool, "in the datasets"]
    reason: Annotated[
        str,
        "kept, or the reason for dropping; of the replay: goal_not_reached, goal_lost, too_short, simulation_unstable, "
        "scene_refused, state_mismatch, worker_lost, no_reference, the reason of a rejected physics "
        "perturbation, or the column beyond a limit of `filter`; of the frames: too_dark, blown_out, "
        "task_object_not_seen, hand_not_seen, added_objects_not_seen, camera_missing, worker_lost; of the selection: "
        "reserve_not_needed, left_out (by export.where)",
    ]
    chosen: Annotated[bool, "true if export.where selects the episode, or is not set"]
    replay_mode: Annotated[
        str | None, "open_loop or tracked: method that produced the executed actions; null when not replayed"
    ]
    steps: Annotated[int | None, "executed actions (episode length), null when not replayed"]
    exceeds_step_limit: Annotated[
        bool | None,
        "steps above the limit at which an evaluation of the suite ends (220 spatial, 280 object, 300 goal, 520 long, "
        "400 libero_90); null when not replayed, and for the user's own suites",
    ]
    resolved: Annotated[
        str | None,
        "JSON of the results of physics perturbations in the scene, by axis, or under fault the reason of a failed "
        "simulation; positions of pose are those before the objects settle; null when not replayed",
    ]
    path_ratio: Annotated[
        float | None, "path_m divided by path_m of the clean twin; null if one of them did not reach the goal"
    ]
    gl_device: Annotated[str | None, "OpenGL name of the device that rendered the frames; null when not rendered"]
    actions_sha256: Annotated[
        str | None,
        "SHA-256 of the stored actions (float32, rows of 7); equal for equal sequences; null when not rendered",
    ]
    subtask_starts: Annotated[
        list[int] | None,
        "first step of each subtask, in order; a subtask lasts until the next begins; empty if the robot manipulates "
        "nothing that the goal names; null when not rendered",
    ]
    subtask_texts: Annotated[list[str] | None, "each subtask in words; null when not rendered"]
    rewrites: Annotated[
        str | None,
        "other wordings of the task that training may use in place of the instruction: all that the run's language "
        "axis may sample for the episode, also its own rewrite; in the manifest a JSON list, null when not rendered",
    ]


class Settings(Frozen):
    """Settings that all episodes of a run share; with them and its row, an episode can be generated again.

    Attributes:
        source: ``starter`` or ``hdf5``, without the folder of the files, which differs from machine to machine.
        episodes: ``plan.episodes``, the wanted numbers. Manifests of earlier versions lack it.
    """

    source: Literal["starter", "hdf5"]
    replay: ReplayConfig
    render: RenderConfig
    episodes: dict[str, int] = Field(default_factory=dict)

    @classmethod
    def of(cls, config: Config) -> Settings:
        return cls(
            source=config.demos.source,
            replay=config.replay,
            render=config.render,
            episodes=config.plan.episodes,
        )


def build(
    outcome: Outcome,
    places: Mapping[str, Mapping[str, Any]],
    columns: Sequence[pa.Field],
    where: Where | None,
    rewrites: Callable[[plan.Row], Sequence[str]],
) -> pa.Table:
    """Join the plan with the results of its episodes.

    Args:
        outcome: plan, verdicts and stored files of a run.
        places: id of every kept episode to its place in the datasets.
        columns: columns of ``places``.
        where: ``export.where``.
        rewrites: function that returns the rewrites of an episode.
    """
    version_of_column = {version_column(name): version for name, version in versions().items()}
    table = []
    for row in outcome.rows:
        verdict = outcome.verdicts[row.episode_id]
        # The trajectory of a reserve that was not needed may be stored for another episode.
        replayed = outcome.trajectories.get(row.trajectory_id, {}) if verdict.reason != NOT_NEEDED else {}
        frames = outcome.frames[row.trajectory_id] if replayed and outcome.has_frames(row) else None
        result = Result(
            kept=verdict.kept,
            reason=verdict.reason,
            chosen=is_selected(row, where),
            replay_mode=replayed.get("mode"),
            steps=replayed.get("steps"),
            exceeds_step_limit=exceeds_step_limit(row.suite, replayed["steps"]) if replayed else None,
            resolved=replayed.get("resolved"),
            path_ratio=_ratio(replayed, outcome.trajectories.get(outcome.row_of[row.twin_id].trajectory_id, {})),
            gl_device=frames.device if frames else None,
            actions_sha256=frames.actions_sha256 if frames else None,
            subtask_starts=[subtask.step for subtask in frames.subtasks] if frames else None,
            subtask_texts=[subtask.text for subtask in frames.subtasks] if frames else None,
            rewrites=json.dumps(list(rewrites(row))) if frames else None,
        )
        quality = {each.name: replayed.get(each.name) for each in fields(Quality)}
        place = places.get(row.episode_id, {})
        table.append({**asdict(row), **asdict(result), **quality, **place, **version_of_column})
    return pa.Table.from_pylist(table, schema=schema(columns))


def _ratio(replayed: Mapping[str, Any], twin: Mapping[str, Any]) -> float | None:
    path_m, twin_path_m = replayed.get("path_m"), twin.get("path_m")
    return path_m / twin_path_m if path_m is not None and twin_path_m else None


def schema(places: Sequence[pa.Field] = ()) -> pa.Schema:
    """Return the columns: the plan, its result and quality, the place in each dataset, and the versions."""
    made_by = [column(version_column(name), pa.string(), meaning) for name, meaning in VERSIONS.items()]
    return pa.schema([*columns_of(plan.Row), *columns_of(Result), *columns_of(Quality), *places, *made_by])


def described(places: Sequence[pa.Field]) -> dict[str, Any]:
    """Return the content of ``schemas/manifest.json``, which describes every column for readers."""
    columns = []
    for each in schema(places):
        meaning = each.metadata[b"meaning"].decode()
        columns.append({"name": each.name, "type": str(each.type), "meaning": meaning})
    return {"columns": columns}


def write(table: pa.Table, path: Path, settings: Settings) -> None:
    write_table(table.replace_schema_metadata({_SETTINGS: settings.model_dump_json()}), path)


def read(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a manifest.

    Raises:
        PipelineError: when the file is missing, damaged or not a manifest of this version.
    """
    rows = list(read_table(path, schema().names, RUN_AGAIN).to_pylist())
    # Episodes of a task have equal rewrites, of 3 kB. One copy of each is kept.
    texts: dict[str, str] = {}
    for row in rows:
        row["rewrites"] = texts.setdefault(row["rewrites"], row["rewrites"])
    return rows


def read_labels(row: Mapping[str, Any]) -> dict[str, list[Any]] | None:
    """Return the subtasks and rewrites of an episode's row, as the lists of a dataset; `None` if the row has none."""
    labels = {name: row[name] for name in SCHEMA.labels}
    if None in labels.values():
        return None
    return {**labels, "rewrites": json.loads(labels["rewrites"])}


def settings(path: Path) -> Settings:
    """Read the settings that the episodes of a manifest share.

    Raises:
        PipelineError: when the file has no settings, or lacks columns of this version.
    """
    try:
        stored = pq.read_schema(path)
        lacking = set(schema().names) - set(stored.names)
        if lacking:
            raise KeyError(sorted(lacking))
        return Settings.model_validate_json(stored.metadata[_SETTINGS])
    except (OSError, pa.ArrowException, TypeError, KeyError, ValidationError) as error:
        raise PipelineError(
            f"the file is not a manifest of this version ({error})",
            where=path,
            expected="the columns of schemas/manifest.json, and the settings that generated its episodes",
            remedy=MAKE_AGAIN,
        ) from error


def made_with(row: Mapping[str, Any]) -> dict[str, str]:
    """Map each package to the version that a row was generated with."""
    return {DISTRIBUTION if name == "pipeline" else name: row[version_column(name)] for name in VERSIONS}
