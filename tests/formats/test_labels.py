"""Subtasks and rewrites of an episode in every format, as readers find them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from synthetic import (
    IDS,
    REPO,
    REWRITES,
    SUBTASKS,
    WITHOUT_LABELS,
    episode,
    write_lerobot,
    write_lerobot_v21,
    write_rlds,
)

from pipeline.episode_check import check
from pipeline.episode_schema import labels_of
from pipeline.errors import PipelineError
from pipeline.formats.base import Format
from pipeline.formats.read_back import Copy, Fault
from pipeline.run.rewrites import list_episode_rewrites
from pipeline.types import Episode, Subtask
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS


@pytest.mark.parametrize("write", [write_rlds, write_lerobot, write_lerobot_v21])
def test_each_format_returns_the_labels_of_each_episode(write: Callable[[Path], Format[Any]], tmp_path: Path) -> None:
    dataset = write(tmp_path)
    places = dataset.record().places
    for episode_id in IDS:
        row = {**places.get(episode_id, {}), "episode_id": episode_id, "demo_id": episode_id}
        copy = dataset.read(row)
        assert copy is not None
        expected = ((), ()) if episode_id == WITHOUT_LABELS else (SUBTASKS, REWRITES)
        assert (tuple(copy.episode.subtasks), tuple(copy.episode.rewrites)) == expected


def test_lerobot_has_the_labels_in_its_table_of_episodes(tmp_path: Path) -> None:
    episodes = LeRobotDataset(REPO, root=write_lerobot(tmp_path).root, video_backend="pyav").meta.episodes
    for index, episode_id in enumerate(IDS):
        stored = {name: episodes[index][name] for name in ("subtask_starts", "subtask_texts", "rewrites")}
        assert stored == labels_of(episode(episode_id))


def in_manifest(made: Episode) -> dict[str, Any]:
    """Return an episode's labels as a row of the manifest has them."""
    return {**labels_of(made), "rewrites": json.dumps(list(made.rewrites))}


def found_in(row: dict[str, Any], changed: Episode) -> list[tuple[str, str]]:
    made = episode(IDS[1])
    copy = Copy("rlds", changed, [made.instruction] * len(made), {}, {}, {})
    no_replay: Any = None
    faults: list[Fault] = [*CHECKS["labels"].find(Case({**in_manifest(made), **row}, made, no_replay, [copy], None))]
    return [(fault.dataset, fault.what) for fault in faults]


def test_validate_reports_labels_that_differ_from_the_manifest() -> None:
    made = episode(IDS[1])
    assert found_in({}, made) == []
    later = replace(made, subtasks=(SUBTASKS[0], Subtask(6, SUBTASKS[1].text), SUBTASKS[2]))
    assert found_in({}, later) == [("rlds", "subtask_starts is [0, 6, 10]")]
    assert found_in({}, replace(made, rewrites=REWRITES[:1])) == [("rlds", f"rewrites is {[*REWRITES[:1]]}")]
    lacking = dict.fromkeys(labels_of(made))
    assert found_in(lacking, made) == [("manifest", "has no subtasks and rewrites")]


@pytest.mark.parametrize(
    ("starts", "what"),
    [
        ([0, 10, 5], "are not in order"),
        ([0, 5, 5], "are not in order"),
        ([1, 5, 10], "the first of subtask_starts is 1"),
        ([0, 5, 400], "leave the episode"),
        ([0, 5], "2 subtask_starts and 3 subtask_texts"),
    ],
)
def test_validate_reports_starts_that_no_reader_can_use(starts: list[int], what: str) -> None:
    first, *_ = found_in({"subtask_starts": starts}, episode(IDS[1]))
    assert first[0] == "manifest"
    assert what in first[1]


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"subtasks": (SUBTASKS[0], SUBTASKS[2], SUBTASKS[1])}, "not in order"),
        ({"subtasks": (Subtask(0, " "),)}, "the label ' '"),
        ({"rewrites": ("one\ntwo",)}, "the label"),
        ({"rewrites": (*REWRITES, REWRITES[0])}, "some are equal"),
    ],
)
def test_writers_reject_labels_that_training_would_misread(changes: dict[str, Any], what: str) -> None:
    with pytest.raises(PipelineError, match=what):
        check(replace(episode(IDS[1]), **changes))


@pytest.mark.parametrize(
    ("task", "name", "category", "word"),
    [
        ("pick_up_the_salad_dressing_and_place_it_in_the_basket", "libero/wine_bottle", "bottle_of_wine", "bottle"),
        ("pick_up_the_cream_cheese_and_place_it_in_the_basket", "libero/cookies", "box", "box"),
        ("pick_up_the_butter_and_place_it_in_the_basket", "libero/moka_pot", "moka_pot", "kettle"),
    ],
)
def test_no_rewrite_names_an_added_object(task: str, name: str, category: str, word: str) -> None:
    added = {"name": name, "category": category, "sha256": "0" * 64, "licence": "MIT", "attribution": ""}
    layout = {"axis": "layout", "component": "objects", "level": 1, "objects": [added], "seed": 1}
    milk = {**layout, "objects": [{**added, "category": "milk"}]}
    kept, others = (
        list_episode_rewrites(None, "libero_object", task, json.dumps([change])) for change in (layout, milk)
    )
    naming = [text for text in others if word in text.split()]
    assert naming
    assert [text for text in others if text not in naming] == list(kept)
