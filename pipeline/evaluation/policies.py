"""What acts: a policy behind a model server's address, or a lerobot checkpoint on disk."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pipeline.errors import PipelineError
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.types import Floats

Look = Callable[[bool, bool], dict[str, Any]]
"""Gives the observation, with the wrist's view and the state if asked for; frames are rendered when it is called."""


class Policy(Protocol):
    """Asked for actions until the episode is over."""

    name: str

    def begin(self, task: EvaluationTask) -> None:
        """An episode begins."""
        ...

    def act(self, look: Look) -> Floats:
        """(n, 7) the actions to take next, or (7,) for one; looks only when it has to."""
        ...

    def end(self, success: bool) -> None:
        """It is over."""
        ...

    def close(self) -> None: ...


class Server:
    """A model server of vla-eval. It is asked at every step, or, where it answers with a chunk, once in a chunk.

    Args:
        address: such as ``ws://localhost:8000``.
        timeout_s: how long an answer may take.
        look_every: see ``PerturbedLibero``.
    """

    def __init__(self, address: str, timeout_s: float = 120.0, look_every: int = 1):
        try:
            from vla_eval.connection import Connection
        except ImportError as error:
            raise PipelineError(
                "the package vla-eval is not installed", remedy="pip install vla-eval==0.8.0"
            ) from error
        self.name, self._address, self._look_every = address, address, look_every
        self._loop = asyncio.new_event_loop()
        self._connection = Connection(address, timeout=timeout_s, max_retries=3)
        self._run(self._connection.connect(benchmark="PerturbedLibero"))
        wanted = self._connection.server_info.get("observation_params") or {}
        self._wrist, self._state = bool(wanted.get("send_wrist_image")), bool(wanted.get("send_state"))
        self._asked = 0
        self._seen: dict[str, Any] = {}

    def begin(self, task: EvaluationTask) -> None:
        from dataclasses import asdict

        self._asked = 0
        self._run(self._connection.start_episode({"task": {**asdict(task), "name": str(task), "task_name": task.name}}))

    def act(self, look: Look) -> Floats:
        if self._asked % self._look_every == 0:
            self._seen = look(self._wrist, self._state)
        self._asked += 1
        answer = self._run(self._connection.act(self._seen))
        actions: Floats = np.asarray(answer.get("actions", answer.get("action")))
        return actions

    def end(self, success: bool) -> None:
        self._run(self._connection.end_episode({"metrics": {"success": success}}))

    def close(self) -> None:
        self._run(self._connection.close())
        self._loop.close()

    def _run(self, awaited: Any) -> Any:
        try:
            return self._loop.run_until_complete(awaited)
        except (OSError, RuntimeError, TimeoutError) as error:
            raise PipelineError(
                f"the model server does not answer as it should ({error})",
                where=self._address,
                remedy="check the server's log; run the same command again to go on where this stopped",
            ) from error
