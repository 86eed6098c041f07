"""A model server that is shown few observations is shown the right ones: those that it computes new actions from."""

import asyncio
import json
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from functools import cache
from pathlib import Path
from typing import Any

import libero_environment  # noqa: F401 - robosuite with OpenGL, for the harness's classes
import pytest
from checkout import REPOSITORY
from server_process import running
from short_demonstrations import STOVE
from vla_eval.connection import Connection
from vla_eval.runners.sync_runner import SyncEpisodeRunner

from pipeline.errors import PipelineError
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.harness import PerturbedLibero
from pipeline.evaluation.model_server import Server
from pipeline.evaluation.rollout import roll_out_policy
from pipeline.evaluation.selection import Selection, select
from pipeline.libero.tasks import STEP_LIMITS

STEPS, LOOK_EVERY = 17, 8
CHOSEN = Selection(suites=(STOVE.suite,), tasks=(STOVE.name,))
(TASK,) = select(CHOSEN)

Run = Callable[[str, int], int]
"""Runs the episode with the server at an address, which looks once in so many steps; how many looks were rendered."""


@cache
def opened() -> EpisodeEnvironment:
    return EpisodeEnvironment()


def ours(address: str, look_every: int) -> int:
    with closing(Server(address, look_every=look_every)) as server:
        roll_out_policy(opened(), server, TASK)
    assert opened().progress.steps == STEPS
    return opened().episode.looks


@cache
def opened_by_harness(look_every: int) -> PerturbedLibero:
    selection = {"suites": CHOSEN.suites, "tasks": CHOSEN.tasks}
    return PerturbedLibero(selection, look_every=look_every, send_wrist_image=True, send_state=True)


def harness(address: str, look_every: int) -> int:
    """By the runner of vla-eval itself."""
    benchmark = opened_by_harness(look_every)

    async def run() -> None:
        async with Connection(address) as connection:
            await SyncEpisodeRunner().run_episode(benchmark, TASK.for_harness(), connection, max_steps=STEPS)

    asyncio.run(run())
    assert benchmark._environment.progress.steps == STEPS
    return benchmark._environment.episode.looks


def recording(out: Path, chunk: int, keeps: bool) -> AbstractContextManager[str]:
    """The address of a server that writes into a file what it computes new actions from."""
    options = ["--args.out", str(out), "--args.chunk", str(chunk), "--args.keeps", str(keeps).lower()]
    return running(str(REPOSITORY / "tests" / "recording_server.py"), *options)


def shown(run: Run, address: str, out: Path, look_every: int) -> tuple[dict[int, str], int]:
    """Control step to the observation from which the server computed new actions, and the number of looks."""
    looks = run(address, look_every)
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    out.unlink()
    assert len(dict(lines)) == len(lines)
    return dict(lines), looks


@pytest.fixture(scope="module", autouse=True)
def short() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(STEP_LIMITS, STOVE.suite, STEPS)
        yield
    opened().close()
    opened_by_harness(LOOK_EVERY).cleanup()


def test_the_harness_rejects_absolute_actions() -> None:
    with pytest.raises(PipelineError, match="--actions absolute"):
        PerturbedLibero(absolute_action=True)


def test_rows_of_the_harness_need_a_folder_and_a_label(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match="out: DIR"):
        PerturbedLibero(label="act")
    with pytest.raises(PipelineError, match="--label NAME"):
        PerturbedLibero(out=str(tmp_path))


@pytest.fixture(scope="module")
def at_every_step(tmp_path_factory: pytest.TempPathFactory) -> dict[int, str]:
    """What a run shows that looks at every step, whose server computes at every step."""
    out = tmp_path_factory.mktemp("every") / "shown.jsonl"
    with recording(out, 1, False) as address:
        observations, looks = shown(ours, address, out, 1)
    assert list(observations) == list(range(STEPS))
    assert len({*observations.values()}) == looks == STEPS
    return observations


@pytest.mark.slow
@pytest.mark.parametrize(("chunk", "keeps"), [(5, False), (LOOK_EVERY, True)])
def test_new_actions_are_computed_from_the_state_as_it_is(
    at_every_step: dict[int, str], tmp_path: Path, chunk: int, keeps: bool
) -> None:
    """A server answers with its chunk, of any length, or keeps it and answers with one action at a time."""
    out, starts = tmp_path / "shown.jsonl", range(0, STEPS, chunk)
    with recording(out, chunk, keeps) as address:
        for run in (ours, harness):
            observations, looks = shown(run, address, out, LOOK_EVERY)
            assert observations == {step: at_every_step[step] for step in starts}, run
            assert looks == len(starts)
