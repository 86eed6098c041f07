"""What acts: a policy behind a model server's address, or a lerobot checkpoint on disk."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from pipeline.axes.base import Frozen
from pipeline.errors import PipelineError
from pipeline.evaluation.checkpoint import Checkpoint, content_of
from pipeline.evaluation.reference_policies import Replay, TrackedReplay
from pipeline.evaluation.settings import Look, PolicyError, Wanted, checked_actions
from pipeline.evaluation.tasks import EvaluationTask


class Policy(Protocol):
    """Asked for actions until the episode is over."""

    name: str
    wanted: Wanted
    """What it looks at."""

    def begin(self, task: EvaluationTask) -> None:
        """An episode begins."""
        ...

    def act(self, look: Look) -> Any:
        """The actions to take next, (n, 7) or (7,) for one, as ``checked_actions`` takes them; looks only when it has
        to.

        Raises:
            PolicyError: when there is no answer.
        """
        ...

    def end(self, success: bool) -> None:
        """It is over."""
        ...


class PolicyConfig(Frozen):
    """What acts.

    Attributes:
        kind: ``server`` for a model server's address, ``checkpoint`` for a folder that lerobot saved, ``open_loop`` for
            the demonstrations' own actions, ``tracked`` for their paths, followed by feedback.
        address: of the server, such as ``ws://localhost:8000``, or the folder; empty for the demonstrations.
        label: name in the results. A server must have one, another for each policy: nothing else tells what is behind
            its address.
        timeout_s: how long a server's answer may take.
    """

    kind: Literal["server", "checkpoint", "open_loop", "tracked"]
    address: str = ""
    label: str = ""
    timeout_s: float = 120.0

    def identity(self) -> str:
        """What is the same for the same policy alone: ``sha256:`` and the content of a checkpoint, ``script:`` and the
        kind of a replay, or ``claimed:`` and the label, where nobody but the user knows.

        Raises:
            PipelineError: when a server has no label, or a folder no checkpoint.
        """
        match self.kind:
            case "checkpoint":
                return f"sha256:{content_of(Path(self.address))}"
            case "server" if not self.label:
                raise PipelineError(
                    "this server has no label",
                    where=self.address,
                    expected="--label NAME, another for each policy: an address does not tell what is behind it, and "
                    "results of another policy there would be taken for this one's",
                )
            case "server":
                return f"claimed:{self.label}"
            case _:
                return f"script:{self.kind}"

    def name(self, identity: str) -> str:
        """In the results: the label, or what has this identity."""
        scripts = {"open_loop": "replay", "tracked": "tracked replay"}
        return self.label or scripts.get(self.kind) or f"{self.address} {identity.removeprefix('sha256:')[:8]}"

    def open(self, look_every: int) -> Policy:
        match self.kind:
            case "server":
                return Server(self.address, self.timeout_s, look_every)
            case "checkpoint":
                return Checkpoint(Path(self.address))
            case "open_loop":
                return Replay()
            case "tracked":
                return TrackedReplay()


class NextLook:
    """When a model server has to be shown the scene anew.

    A server that answers with a chunk (n, 7) computes its next answer when those actions are taken, from what it is
    shown then. One that answers with a single action (7,) may have taken it from a chunk that it keeps, which nobody
    but itself knows; it is shown the scene once in ``every`` control steps.
    """

    def __init__(self, every: int):
        self._every, self._left = every, 0

    def begin(self) -> None:
        """An episode begins."""
        self._left = 0

    @property
    def due(self) -> bool:
        return self._left == 0

    def looked(self) -> None:
        self._left = self._every

    def answered(self, actions: Any) -> None:
        """Args: actions: (n, 7) or (7,), all of which are taken before the next question."""
        self._left = self._left - 1 if np.ndim(actions) == 1 else 0


class Server:
    """A model server of vla-eval. It is asked at every step, or, where it answers with a chunk, once in a chunk.

    A connection that failed is closed, and the next episode begins on a new one: the server keeps the state of an
    episode with its connection, and an answer that comes late must not be taken for that to a later question.

    Args:
        address: such as ``ws://localhost:8000``.
        timeout_s: how long an answer may take.
        look_every: see ``NextLook``.

    Raises:
        PipelineError: when no server answers there.
    """

    def __init__(self, address: str, timeout_s: float = 120.0, look_every: int = 1):
        try:
            from vla_eval.connection import Connection
        except ImportError as error:
            raise PipelineError(
                "the package vla-eval is not installed", remedy="pip install vla-eval==0.8.0"
            ) from error
        self.name, self._next_look = address, NextLook(look_every)
        self._loop = asyncio.new_event_loop()
        self._connection = Connection(address, timeout=timeout_s, max_retries=3)
        self._connect()
        self._seen: dict[str, Any] = {}

    def begin(self, task: EvaluationTask) -> None:
        self._next_look.begin()
        if not self._connection.is_connected:
            self._connect()
        self._run(self._connection.start_episode({"task": task.for_harness()}), self._connection.timeout)

    def act(self, look: Look) -> Any:
        if self._next_look.due:
            self._seen = look(self.wanted)
            self._next_look.looked()
        if not self._connection.is_connected:
            raise self._fault("the connection was closed")
        answer = self._run(self._connection.act(self._seen), self._connection.timeout)
        if not isinstance(answer, dict):
            raise self._fault(f"the model server answers with {type(answer).__name__}")
        actions = answer.get("actions", answer.get("action"))
        checked_actions(actions, self.name)
        self._next_look.answered(actions)
        return actions

    def end(self, success: bool) -> None:
        # The episode is over, whether the server hears of it or not.
        with suppress(PolicyError):
            self._run(self._connection.end_episode({"metrics": {"success": success}}), self._connection.timeout)

    def close(self) -> None:
        self._loop.run_until_complete(self._connection.close())
        self._loop.close()

    def _connect(self) -> None:
        """Raises: PipelineError: when no server answers, which is not the fault of one episode."""
        try:
            self._run(self._connection.connect(benchmark="PerturbedLibero"))
        except PolicyError as error:
            raise PipelineError(
                error.what,
                where=self.name,
                expected="a model server of vla-eval",
                remedy="check its address and its log, start it, and run the same command again: finished episodes are "
                "kept",
            ) from error
        wanted = self._connection.server_info.get("observation_params") or {}
        self.wanted = Wanted(
            bool(wanted.get("send_wrist_image")),
            bool(wanted.get("send_state")),
            not wanted.get("quat_no_antipodal"),
        )

    def _run(self, awaited: Any, limit_s: float | None = None) -> Any:
        from websockets.exceptions import WebSocketException

        try:
            # Sending waits too, once a server that hangs has let its buffers fill.
            return self._loop.run_until_complete(asyncio.wait_for(awaited, limit_s))
        except TimeoutError as error:
            raise self._fault(f"no answer within {self._connection.timeout:g} s") from error
        except (OSError, RuntimeError, ValueError, WebSocketException) as error:
            what = str(error) or type(error).__name__
            raise self._fault(f"the model server does not answer as it should ({what})") from error

    def _fault(self, what: str) -> PolicyError:
        self._loop.run_until_complete(self._connection.close())
        return PolicyError(what, where=self.name, remedy="see the server's log")
