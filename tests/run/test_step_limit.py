"""Episodes that take longer than an evaluation allows are marked, reported, and dropped where a run asks for it.

The starter set's demonstration of the wine bottle has 347 actions after no-ops; evaluations of libero_goal end at 300.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from pipeline.compute.pool import loop
from pipeline.config import DemosConfig, FilterConfig, ReplayConfig
from pipeline.episode_schema import STANDARD
from pipeline.libero import hdf5
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import exceeds_step_limit, find_task
from pipeline.planning.plan import Row, twins
from pipeline.run import counts, manifest
from pipeline.run.outcome import Outcome
from pipeline.run.replay_stage import Replays
from pipeline.run.verdicts import verdicts_of
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Verdict
from pipeline.validation.demonstrations import check

WINE = find_task("libero_goal", "put_the_wine_bottle_on_the_rack")
DROP = FilterConfig(exceeds_step_limit="drop")


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Row, TrajectoryStore]:
    folder = tmp_path_factory.mktemp("wine")
    demos = DemosConfig(tasks=(str(WINE),))
    (entry,) = StarterSource().index([WINE]).entries
    (row,) = twins([entry], 0, ReplayConfig())
    Replays(demos, ReplayConfig(), TrajectoryStore(folder), loop).complete([row])
    return row, TrajectoryStore(folder)


def test_the_limits_are_those_of_the_evaluation() -> None:
    """OpenVLA's own numbers (`run_libero_eval.py`), and a suite of one's own, which has none."""
    limits = {"libero_spatial": 220, "libero_object": 280, "libero_goal": 300, "libero_10": 520, "libero_90": 400}
    for suite, limit in limits.items():
        assert not exceeds_step_limit(suite, limit)
        assert exceeds_step_limit(suite, limit + 1)
    assert exceeds_step_limit("mine", 10_000) is None


@pytest.mark.slow
def test_the_wine_bottle_is_marked_and_reported(replayed: tuple[Row, TrajectoryStore]) -> None:
    row, store = replayed
    verdicts = verdicts_of(store.rows(), [row], FilterConfig())
    run = Outcome([row], store.rows(), {}, STANDARD.views, {row.episode_id: verdicts[row.trajectory_id]})
    (told,) = manifest.build(run, {}, [], None, lambda _: ()).to_pylist()
    assert (told["kept"], told["steps"], told["exceeds_step_limit"]) == (True, 347, True)
    (sentence,) = counts.beyond_step_limit([told])
    assert "347 of 300, in libero_goal/put_the_wine_bottle_on_the_rack" in sentence
    assert counts.beyond_step_limit([told | {"exceeds_step_limit": False}]) == []


def test_the_reported_episode_is_the_longest_for_its_limit() -> None:
    """530 steps are 1.02 times the limit of the long suite, 347 steps 1.16 times that of the goal suite."""
    rows = [
        {"suite": suite, "task": "a", "steps": steps, "kept": True, "exceeds_step_limit": True}
        for suite, steps in (("libero_10", 530), ("libero_goal", 347))
    ]
    for listed in (rows, rows[::-1]):
        (sentence,) = counts.beyond_step_limit(listed)
        assert sentence.startswith("2 kept episodes take more control steps")
        assert "at most 347 of 300, in libero_goal/a" in sentence


def test_a_run_that_asks_for_it_drops_the_wine_bottle(replayed: tuple[Row, TrajectoryStore]) -> None:
    row, store = replayed
    name = row.trajectory_id
    assert verdicts_of(store.rows(), [row], FilterConfig()) == {name: Verdict(True, "kept")}
    assert verdicts_of(store.rows(), [row], DROP) == {name: Verdict(False, "exceeds_step_limit")}

    def nothing_to_do(fn: Any, items: Sequence[Any], description: str) -> list[Any]:
        raise AssertionError("a trajectory that is there was replayed again")

    judged = Replays(DemosConfig(), ReplayConfig(), store, nothing_to_do, DROP).complete([row])
    assert judged == {name: Verdict(False, "exceeds_step_limit")}


def test_demos_check_names_it(replayed: tuple[Row, TrajectoryStore], tmp_path: Path) -> None:
    row, store = replayed
    trajectory = store.load(row.trajectory_id)
    states = trajectory.states[:-1]
    recording = hdf5.Recording(trajectory.actions, states, states[:, :9], trajectory.model_xml, {})
    file = tmp_path / WINE.suite / f"{WINE.name}_demo.hdf5"
    hdf5.write(file, WINE, [recording])
    (note,) = check(tmp_path, 0, loop).notes
    assert note.startswith(f"{file} data/demo_0: takes 347 control steps; 1 of 1 demonstrations take more than the 300")
