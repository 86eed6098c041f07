"""What both writers share: how episodes are loaded and how they are split over files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.types import Episode

Load = Callable[[str], Episode]
"""Episode id to episode; picklable, called in worker processes."""


def split(episode_ids: Sequence[str], pieces: int) -> list[list[str]]:
    """Contiguous slices whose sizes differ by at most one, so that their concatenation keeps the caller's order.

    There are ``pieces`` of them, or one per episode when there are fewer episodes than that.

    Raises:
        PipelineError: when there is nothing to write, an id comes twice or ``pieces`` is not positive.
    """
    if not episode_ids:
        raise PipelineError(
            "no episodes to write", expected="1 or more", remedy="read in the manifest why all were dropped"
        )
    twice = [episode_id for episode_id, times in Counter(episode_ids).items() if times > 1]
    if twice:
        raise PipelineError(f"{len(twice)} episodes come twice, such as {twice[0]}", expected="unique ids")
    if pieces < 1:
        raise PipelineError(f"{pieces} output files were asked for", expected="1 or more")
    count = min(pieces, len(episode_ids))
    bounds = [len(episode_ids) * k // count for k in range(count + 1)]
    return [list(episode_ids[start:stop]) for start, stop in pairwise(bounds)]


def folder_bytes(folder: Path) -> int:
    """Size of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
