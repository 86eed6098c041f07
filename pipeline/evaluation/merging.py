"""Results of several folders together: those of one policy become one, whichever machines they were made on."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import PipelineError
from pipeline.evaluation.results import REFUSED, EpisodeFiles, Row, refuse_shared_names
from pipeline.seeding import digest

OUTCOME = ("success", "reason", "steps")
"""What two results of one episode must have in common."""


@dataclass(frozen=True)
class Evaluated:
    """One policy under one set of settings.

    Attributes:
        name: the policy's, with the settings in which it differs from another of the same name.
        settings: what held for all its episodes.
        rows: its episodes, without those that no policy acted in.
        videos: those that there are, by the name of the episode.
        refused: how many episodes could not begin, as their scene did not take what was drawn.
    """

    name: str
    settings: Mapping[str, Any]
    rows: tuple[Row, ...]
    videos: Mapping[str, Path]
    refused: int

    def of(self, source: str) -> tuple[Row, ...]:
        """Its episodes on the tasks of one source."""
        return tuple(row for row in self.rows if row["source"] == source)


def read(folders: Sequence[Path]) -> list[Evaluated]:
    """Read the folders that ``evaluate`` wrote; what several of them hold counts once.

    Raises:
        PipelineError: when a folder has no results, two results of an episode differ, or two policies have one name.
    """
    read_from = [(row, folder) for folder in folders for row in EpisodeFiles(folder).some_rows()]
    refuse_shared_names(read_from)
    results: dict[str, tuple[Row, EpisodeFiles]] = {}
    for row, folder in read_from:
        files = EpisodeFiles(folder)
        earlier, where = results.setdefault(row["episode"], (row, files))
        if any(row[name] != earlier[name] for name in OUTCOME):
            raise PipelineError(
                f"two results of {row['source']}/{row['suite']}/{row['name']} by {row['policy']} differ: "
                + " and ".join(str({name: one[name] for name in OUTCOME}) for one in (earlier, row)),
                where=f"{where.path(row['episode'])} and {files.path(row['episode'])}",
                expected="one result of each episode, the same wherever it was run",
                remedy="leave one of the folders out; run the one again that other versions of the packages made, or "
                "give each of two policies behind a server a --label of its own",
            )
    return _by_policy(list(results.values()))


def _by_policy(results: Sequence[tuple[Row, EpisodeFiles]]) -> list[Evaluated]:
    """Results by identity and settings, in the order of the folders; a policy has the first of its names."""
    groups: dict[tuple[str, str], list[tuple[Row, EpisodeFiles]]] = defaultdict(list)
    for row, files in results:
        groups[row["identity"], digest(row["settings"])].append((row, files))
    policies = []
    for (identity, _), group in groups.items():
        alike = [rows[0][0] for (other, _), rows in groups.items() if other == identity]
        policy, settings = alike[0]["policy"], group[0][0]["settings"]
        differing = [key for key in settings if any(other["settings"].get(key) != settings[key] for other in alike)]
        videos = {row["episode"]: files.video(row["episode"]) for row, files in group}
        policies.append(
            Evaluated(
                ", ".join([policy, *(f"{key.replace('_', ' ')} {settings[key]}" for key in differing)]),
                settings,
                tuple(row for row, _ in group if row["reason"] != REFUSED),
                {episode: path for episode, path in videos.items() if path.is_file()},
                sum(row["reason"] == REFUSED for row, _ in group),
            )
        )
    return policies
