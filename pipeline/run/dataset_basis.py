"""Basis of a dataset: its episodes, and everything else that its bytes depend on."""

from collections import Counter
from importlib.metadata import version
from typing import Any

from pipeline.axes import task_of
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.formats.base import AnyFormat
from pipeline.formats.episodes import EpisodeFacts, Episodes
from pipeline.record import Basis
from pipeline.run.dataset_files import is_unchanged
from pipeline.run.outcome import shuffled
from pipeline.run.rewrites import list_episode_rewrites
from pipeline.run.run import Run
from pipeline.seeding import digest


def episodes_of(dataset: AnyFormat, run: Run) -> Episodes:
    """Return the episodes of a dataset in the order they are written: the kept episodes of a run, or its failures.

    Each episode has all rewrites that the run's language axis may sample for it. Without this axis, its default ranges
    decide.
    """
    failures = dataset.content.is_of_failures
    rewrites: dict[str, tuple[str, ...]] = {}
    outcome, language = run.outcome, run.config.plan.axes.language
    facts: dict[str, EpisodeFacts] = {}
    for episode_id in shuffled(outcome.failures) if failures else outcome.kept:
        row = outcome.row_of[episode_id]
        rewrites[episode_id] = list_episode_rewrites(language, row.suite, row.task, row.perturbations)
        task = task_of(row.suite, row.task, row.perturbations)
        facts[episode_id] = EpisodeFacts(
            row.suite,
            content=digest(outcome.content(episode_id), rewrites[episode_id])[:16],
            demo=row.demo_id,
            instruction=row.instruction,
            steps=outcome.trajectories[row.trajectory_id]["steps"],
            origin=row.demo_origin_sha256,
            scene=task.bddl_file.stem if task.goal_file else "",
        )
    load = run.episode_loader(failures=failures, rewrites=rewrites, replays=dataset.stores_replay)
    return Episodes(facts, load)


def compute_basis(dataset: AnyFormat, episodes: Episodes) -> Basis:
    """Return everything that the bytes of a dataset depend on. Its request consists of episodes and options."""
    contents = [episode.content for episode in episodes.facts.values()]
    identity = digest(
        "export",
        dataset.name,
        dataset.recipe,
        {package: version(package) for package in dataset.packages},
        SCHEMA.model_dump(mode="json"),
        _options(dataset),
        *dataset.content.stated(),
        [[piece.path, piece.ids] for piece in dataset.pieces(episodes)],
        contents,
    )
    requested = digest(_options(dataset), *dataset.content.stated(), contents)[:16]
    schema = digest(SCHEMA.model_dump(mode="json"))[:8]
    return Basis(identity[:16], requested, {**dataset.made_with(), "episode schema": schema})


def _options(dataset: AnyFormat) -> dict[str, Any]:
    """Return a format's options under the field names of the first version that wrote them."""
    dumped: dict[str, Any] = dataset.options.model_dump(mode="json", by_alias=True)
    return dumped


def is_up_to_date(dataset: AnyFormat, episodes: Episodes) -> bool:
    """Return whether the dataset exists, is complete and has these episodes.

    Every file must exist and be no younger than the record.
    """
    return is_unchanged(dataset) and dataset.record().matches(compute_basis(dataset, episodes))


def outdated(dataset: AnyFormat, episodes: Episodes) -> Counter[str]:
    """Count, by reason, the files of a finished dataset that would be generated again although the request is equal."""
    try:
        record = dataset.record()
    except PipelineError:
        return Counter()
    basis = compute_basis(dataset, episodes)
    if record.matches(basis) or not record.same_request(basis):
        return Counter()
    return Counter({f"files, generated with {record.describe_mismatch(basis)}": len(record.files)})
