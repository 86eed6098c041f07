"""A demonstration that cannot be simulated is dropped with a reason and named; the others are replayed all the same."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from short_demonstrations import MILK, STOVE, starter_demo

from pipeline.axes import Axes
from pipeline.axes.layout import LayoutAxis
from pipeline.compute.pool import loop
from pipeline.config import DemosConfig, PlanConfig, ReplayConfig
from pipeline.libero import hdf5
from pipeline.libero.starts import recorded_start
from pipeline.physics.environment import Environment, UnusableSceneError
from pipeline.planning import plan, selection
from pipeline.run.replay_stage import Replays
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset.benchmark import TestSet
from pipeline.types import Scene, Verdict

STEPS = 10
REPLAY = ReplayConfig(mode="auto")
NAME = f"{STOVE.suite}/{STOVE.name}"


def renamed(name: str) -> Callable[[hdf5.Recording], hdf5.Recording]:
    def spoil(good: hdf5.Recording) -> hdf5.Recording:
        assert f'"{name}"' in good.model_file
        return replace(good, model_file=good.model_file.replace(f'"{name}"', f'"other_{name}"'))

    return spoil


def with_model(pattern: str, text: str) -> Callable[[hdf5.Recording], hdf5.Recording]:
    return lambda good: replace(good, model_file=re.sub(pattern, text, good.model_file, count=1))


def of_milk(good: hdf5.Recording) -> hdf5.Recording:
    environment = Environment(MILK)
    milk, states = environment.place_fixtures(0), np.tile(starter_demo(MILK).init_state, (STEPS, 1))
    environment.close()
    return replace(good, model_file=milk, states=states)


def unturned(good: hdf5.Recording) -> hdf5.Recording:
    """The first object's rotation, after the time, the robot's nine positions and the object's three, is all zeros."""
    states = good.states.copy()
    states[:, [13, 14, 15, 16]] = 0.0
    return replace(good, states=states)


BAD: dict[str, tuple[Callable[[hdf5.Recording], hdf5.Recording], str, str]] = {
    "state of another length": (
        lambda good: replace(good, states=good.states[:, :-1]),
        "state_mismatch",
        "has 78 numbers, the scene's has 79",
    ),
    "state without a rotation": (unturned, "state_mismatch", "rotation of length 0"),
    "model that MuJoCo rejects": (
        with_model("<geom ", '<geom colour="red" '),
        "scene_refused",
        "unrecognized attribute",
    ),
    "model of another task": (of_milk, "scene_refused", "akita_black_bowl"),
    "body with another name": (renamed("plate_1_main"), "scene_refused", "plate_1_main"),
    "joint with another name": (renamed("plate_1_joint0"), "scene_refused", "plate_1_joint0"),
    "camera with another name": (renamed("robot0_eye_in_hand"), "scene_refused", "robot0_eye_in_hand"),
    "no surface to put objects on": (renamed("table"), "scene_refused", "table"),
    "forces without end": (with_model("<option ", '<option gravity="0 0 -1e200" '), "simulation_unstable", ""),
}


@pytest.fixture(scope="module")
def good() -> hdf5.Recording:
    environment, demo = Environment(STOVE), starter_demo(STOVE)
    model_xml = environment.place_fixtures(0)
    environment.restore(recorded_start(demo, model_xml))
    states = []
    for action in demo.actions[:STEPS]:
        states.append(environment.state)
        environment.step(action)
    environment.close()
    return hdf5.Recording(demo.actions[:STEPS], np.stack(states), np.zeros((STEPS, 9)), model_xml, {})


@pytest.fixture(scope="module")
def root(good: hdf5.Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One task's file: the first and the last demonstration are good, the others are those of ``BAD``."""
    root = tmp_path_factory.mktemp("bad")
    last = replace(good, actions=good.actions * [*[0.99] * 6, 1.0])
    recordings = [good, *(spoil(good) for spoil, _, _ in BAD.values()), last]
    hdf5.write(root / STOVE.suite / f"{STOVE.name}_demo.hdf5", STOVE, recordings)
    return root


def nothing_left(fn: Callable[..., Any], items: Sequence[Any], description: str) -> list[Any]:
    raise AssertionError(f"{len(items)} jobs are run again")


@pytest.mark.slow
def test_each_bad_demonstration_is_a_verdict(
    root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file in the working folder
    demos = DemosConfig(source="hdf5", root=root, tasks=(NAME,))
    index = demos.index()
    assert not index.problems
    count = len(index.entries)
    axes = Axes(layout=LayoutAxis(levels=(1,)))
    wanted = PlanConfig(seed=0, axes=axes, episodes={"layout": count})
    rows = plan.make(index.entries, wanted, REPLAY, TestSet(()))
    folder = tmp_path / "trajectories"
    verdicts = Replays(demos, REPLAY, TrajectoryStore(folder), loop).complete(rows)
    log, store = capfd.readouterr().err, TrajectoryStore(folder)
    reasons = dict(zip([f"{NAME}/demo_{n}" for n in range(1, count - 1)], BAD.values(), strict=True))
    for row in rows:
        verdict = verdicts[row.trajectory_id]
        if row.demo_id not in reasons:
            assert verdict == Verdict(False, "goal_not_reached"), row
            continue
        _, reason, detail = reasons[row.demo_id]
        assert verdict == Verdict(False, reason), row
        stored = store.load(row.trajectory_id)
        assert stored.verdict == verdict
        if detail:
            assert len(stored.actions) == 0
            assert detail in json.loads(stored.resolved)["fault"]
            assert re.search(rf"{row.demo_id}\b.*{detail}", log), row.demo_id
    assert Replays(demos, REPLAY, TrajectoryStore(folder), nothing_left).complete(rows) == verdicts
    assert all(not verdict.kept for verdict in selection.select(rows, verdicts).values())


@pytest.mark.slow
def test_a_bad_scene_leaves_no_trace_in_its_worker(good: hdf5.Recording) -> None:
    environment = Environment(STOVE)
    reached = []
    for _ in range(2):
        environment.restore(Scene(good.model_file, good.states[0]))
        for action in good.actions:
            environment.step(action)
        reached.append(environment.state)
        with pytest.raises(UnusableSceneError):
            environment.restore(Scene(renamed("plate_1_main")(good).model_file, good.states[0]))
    assert np.array_equal(reached[0], reached[1])
    assert environment.place_fixtures(1) == Environment(STOVE).place_fixtures(1)
