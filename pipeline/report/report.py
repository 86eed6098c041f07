"""The report of a run: one self-contained HTML page with its counts, plots, pictures and videos."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from itertools import chain, islice, zip_longest
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from PIL import Image

from pipeline.axes import Perturbation, TextPerturbation, from_json, task_of
from pipeline.axes.report_data import KeptPerturbation
from pipeline.config import Config
from pipeline.episode_schema import SCHEMA
from pipeline.files import read_json
from pipeline.planning import leakage
from pipeline.planning.streams import streams_of
from pipeline.report import coverage, figures, pages, seen, yields
from pipeline.report.coverage import AxisPlots
from pipeline.report.figures import Panel
from pipeline.report.pages import Clip
from pipeline.report.sheets import describe_episode, name_episode
from pipeline.report.yields import Table
from pipeline.run import counts, manifest
from pipeline.run.counts import Counts, Diversity, Rows, by_axis
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.layout import LEAKAGE, PREVIEWS, SHEETS
from pipeline.run.run import Run
from pipeline.stores.frame_store import FrameStore
from pipeline.testset.benchmark import TestSet
from pipeline.types import Floats, Quality, Task

ById = Mapping[str, Mapping[str, Any]]
"""Episode id to its row of the manifest."""

REWRITES = 12
"""Number of quoted rewrites."""

WORST = 10
"""Number of videos of the largest displacements of other objects."""


class Video(NamedTuple):
    """A perturbed episode next to its clean twin, with a caption."""

    axis: str
    caption: str
    instruction: str
    clip: Clip


def page(run: Run, test: TestSet) -> str:
    """Render the report of a finished run.

    Raises:
        PipelineError: when the run's folder lacks an output of an earlier stage.
    """
    rows, config = run.manifest, run.config
    load = run.episode_loader()
    tried = counts.tried(rows)
    kept = [row for row in tried if row["kept"]]
    distances = leakage.covered_by(kept, read_json(run.path(LEAKAGE)), test)
    twins = counts.twins(rows)
    actions = _actions([*kept, *twins.values()], run.frames)
    axes = list(dict.fromkeys(row["axis"] for row in kept))
    sheets = _pictures(run.path(SHEETS))
    return pages.render(
        "report.html.j2",
        name=config.name,
        origins=counts.origins(kept, config.demos.source),
        headline=_headline(tried, kept),
        yields=[yields.wanted_and_kept(counts.targets(rows, config.plan.episodes)), *yields.tables(tried)],
        diversity=yields.by_task(kept),
        shortfalls=[
            *counts.shortfalls(counts.targets(rows, config.plan.episodes)),
            *counts.lost_to_workers(rows),
            *counts.beyond_step_limit(rows),
        ],
        axes=axes,
        overall=_histograms({axis: _stacked(rows, actions) for axis, rows in by_axis(kept).items()}),
        by_axis=_own_motion(kept, twins, actions),
        lengths=_lengths(rows, kept),
        quality=[_strips(each.name, kept, itemgetter(each.name), each.name) for each in fields(Quality)],
        worst=_worst(kept, twins, load),
        seen=seen.measure(run, test),
        sample=seen.SAMPLE,
        coverage=_coverage(tried, test),
        rewrites=_rewrites(kept),
        leakage=distances,
        videos=_videos(kept, twins, load),
        sheets={axis: sheets[axis] for axis in axes if axis in sheets},
        previews={folder.name: _pictures(folder) for folder in sorted(run.path(PREVIEWS).glob("*"))},
        versions=_versions(rows),
        example=min(row["episode_id"] for row in kept),
        settings=_dumped(config),
    )


def _headline(tried: Rows, kept: Rows) -> dict[str, str]:
    steps = sum(row["steps"] for row in kept)
    headline = {
        **asdict(Counts.of(tried)),
        "kept clean twins": sum(row["role"] == "twin" for row in kept),
        "action sequences": Diversity.of(kept).sequences,
        "tasks": len({(row["suite"], row["task"]) for row in kept}),
        "steps": steps,
        f"minutes at {SCHEMA.fps_hz} Hz": round(steps / SCHEMA.fps_hz / 60),
    }
    return {name: f"{count:,}" for name, count in headline.items()}


def _actions(rows: Rows, frames: FrameStore) -> dict[str, Floats]:
    """Read the actions (T, 7) of each episode, by id; episodes of one trajectory share the array."""
    of_trajectory: dict[str, Floats] = {}
    for row in rows:
        trajectory_id = row["trajectory_id"]
        if trajectory_id not in of_trajectory:
            of_trajectory[trajectory_id] = frames.motion(trajectory_id)[0].astype(np.float64)
    return {row["episode_id"]: of_trajectory[row["trajectory_id"]] for row in rows}


def _histograms(groups: Mapping[str, Floats]) -> list[Panel]:
    low, high = SCHEMA.action.range
    bins = np.linspace(low, high, 42)  # an odd number, so that zero has a bin of its own
    panels = []
    for entry, name in enumerate(SCHEMA.action.names):
        values = {group: rows[:, entry] for group, rows in groups.items()}
        panels.append(figures.histogram(name, values, bins, "action", log=True))
    return panels


def _stacked(rows: Rows, actions: Mapping[str, Floats], key: str = "episode_id") -> Floats:
    return np.concatenate([actions[row[key]] for row in rows])


def _own_motion(kept: Rows, twins: ById, actions: Mapping[str, Floats]) -> dict[str, list[Panel]]:
    """Plot the actions of each axis with replays of its own, next to the actions of the clean twins."""
    panels = {}
    for axis, rows in by_axis(kept).items():
        paired = [row for row in rows if row["twin_id"] in twins]
        if any(row["trajectory_id"] != twins[row["twin_id"]]["trajectory_id"] for row in paired):
            clean = _stacked(paired, actions, "twin_id")
            panels[axis] = _histograms({"clean": clean, axis: _stacked(paired, actions)})
    return panels


def _strips(title: str, rows: Rows, of: Callable[[Mapping[str, Any]], float | None], label: str) -> Panel:
    """Plot a number of each episode, by axis; episodes without the number are left out."""
    groups = {}
    for axis, of_axis in by_axis(rows).items():
        values = [of(row) for row in of_axis]
        stated = [value for value in values if value is not None]
        groups[axis] = {axis: np.array(stated, float)}
    return figures.strips(title, groups, label)


def _lengths(rows: Rows, kept: Rows) -> list[Panel]:
    panels = []
    for suite in dict.fromkeys(row["suite"] for row in kept):
        of_suite = [row for row in kept if row["suite"] == suite]
        panels.append(_strips(suite, of_suite, itemgetter("steps"), "steps"))
    steps = {row["episode_id"]: row["steps"] for row in rows}

    def longer(row: Mapping[str, Any]) -> float | None:
        return row["steps"] - steps[row["twin_id"]] if steps[row["twin_id"]] else None

    perturbed = [row for row in kept if row["axis"] != "clean"]
    return [*panels, _strips("Difference from the clean twin", perturbed, longer, "steps")] if perturbed else panels


def _worst(kept: Rows, twins: ById, load: EpisodeLoader) -> list[Video]:
    """Show the trajectories that moved an object outside the goal farthest, next to their clean twins."""
    clean = {row["trajectory_id"] for row in twins.values()}
    paired = [row for row in kept if row["twin_id"] in twins and row["trajectory_id"] not in clean]
    row_of_trajectory = {row["trajectory_id"]: row for row in paired}
    moving = [row for row in row_of_trajectory.values() if row["non_target_moved_m"]]
    worst = sorted(moving, key=lambda row: (-row["non_target_moved_m"], row["episode_id"]))[:WORST]
    return [_video(row, load, f"{name_episode(row)}: {100 * row['non_target_moved_m']:.1f} cm") for row in worst]


def _coverage(tried: Rows, test: TestSet) -> dict[str, tuple[AxisPlots, Table]]:
    plots_and_tables = {}
    perturbed_on: dict[str, list[tuple[Mapping[str, Any], Perturbation]]] = {}
    for row in tried:
        for perturbation in from_json(row["perturbations"]):
            perturbed_on.setdefault(perturbation.axis, []).append((row, perturbation))
    for axis, of_axis in perturbed_on.items():
        table = yields.by_level("Kept/planned episodes, by component", [row for row, _ in of_axis], axis)
        kept = []
        for row, perturbation in of_axis:
            if row["kept"]:
                resolved = json.loads(row["resolved"]).get(axis)
                kept.append(KeptPerturbation(_task(row), perturbation, resolved))
        plots_and_tables[axis] = coverage.plot_axis(axis, kept, test), table
    return plots_and_tables


def _task(row: Mapping[str, Any]) -> Task:
    return task_of(row["suite"], row["task"], row["perturbations"])


def _rewrites(kept: Rows) -> list[tuple[str, str, str]]:
    """Quote class and level, original instruction and rewrite, with the classes in turn."""
    quoted: dict[str, list[tuple[str, str, str]]] = {}
    for row in kept:
        for perturbation in from_json(row["perturbations"]):
            if isinstance(perturbation, TextPerturbation):
                original = _task(row).instruction
                label = f"{perturbation.component.replace('_', ' ')}, level {perturbation.level}"
                quoted.setdefault(perturbation.component, []).append((label, original, row["instruction"]))
    dealt = chain.from_iterable(zip_longest(*quoted.values()))
    return list(islice(filter(None, dealt), REWRITES))


def _videos(kept: Rows, twins: ById, load: EpisodeLoader) -> list[Video]:
    """Show, for each axis, the strongest episode that changes the agent view, next to its clean twin.

    Among equally strong episodes, the shortest is shown.
    """
    videos = []
    for rows in by_axis(kept).values():
        paired = [row for row in rows if row["twin_id"] in twins]
        visible = [row for row in paired if _agent_view(row) != _agent_view(twins[row["twin_id"]])]
        if visible:
            row = min(visible, key=lambda row: (-_level(row), row["steps"], row["episode_id"]))
            caption = f"{name_episode(row)}: {describe_episode(row)}"
            videos.append(_video(row, load, caption))
    return videos


def _video(row: Mapping[str, Any], load: EpisodeLoader, caption: str) -> Video:
    twin, episode = load(row["twin_id"]), load(row["episode_id"])
    return Video(
        row["axis"], caption, row["instruction"], pages.show_side_by_side(twin.frames["image"], episode.frames["image"])
    )


def _agent_view(row: Mapping[str, Any]) -> tuple[object, str]:
    return streams_of(row["perturbations"])["image"], row["trajectory_id"]


def _level(row: Mapping[str, Any]) -> int:
    return max(perturbation.level for perturbation in from_json(row["perturbations"]))


def _pictures(folder: Path) -> dict[str, str]:
    return {file.stem: pages.picture(Image.open(file)) for file in sorted(folder.glob("*.png"))}


def _versions(rows: Rows) -> dict[str, str]:
    devices = sorted({row["gl_device"] for row in rows if row["gl_device"]})
    seeds = sorted({str(row["seed"]) for row in rows})
    return {**manifest.made_with(rows[0]), "rendered by": "; ".join(devices), "seed": ", ".join(seeds)}


class _ConfigDumper(yaml.SafeDumper):
    """A YAML dumper that writes only the last name of an absolute path, because the page may be published."""


_ConfigDumper.add_multi_representer(
    Path, lambda dumper, path: dumper.represent_str(path.name if path.is_absolute() else path.as_posix())
)


def _dumped(config: Config) -> str:
    # The place of computation changes no result, and would make the pages differ. The card has `publish`.
    chosen = config.model_dump(exclude_defaults=True, exclude={"compute", "folder", "publish"})
    return yaml.dump(chosen, Dumper=_ConfigDumper, sort_keys=False)
