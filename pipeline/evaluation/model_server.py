"""Policies behind a model server of vla-eval."""

import asyncio
import logging
from contextlib import closing, suppress
from typing import Any

import numpy as np

from pipeline.errors import PipelineError
from pipeline.evaluation.actions import Actions, PolicyError, checked_actions, reject_other_actions
from pipeline.evaluation.policies import Look, StateAngle, Wanted, is_shortest
from pipeline.evaluation.tasks import EvaluationTask


class NextLook:
    """Counter of the actions until a model server needs a new observation.

    A server that answers with a chunk (n, 7) computes its next answer after these actions, from a new observation. A
    server that answers with a single action (7,) may take it from a chunk that only the server knows. It gets a new
    observation every ``every`` control steps.
    """

    def __init__(self, every: int):
        self._every = every
        self.left = 0
        """Number of actions before the next observation. At 0, for example when an episode begins, it is due."""

    def answered(self, actions: Any) -> None:
        """Count an answer.

        Args:
            actions: (n, 7) or (7,) actions, which are all taken before the server is asked again.
        """
        self.left = (self.left or self._every) - 1 if np.ndim(actions) == 1 else 0


REQUESTS = ("send_wrist_image", "send_state")
"""Parameters of vla-eval by which a model server asks for the wrist view and for the state, or leaves them out."""


class Server:
    """Model server of vla-eval. It is asked at every step, or once per chunk if it answers with chunks.

    A failed connection is closed, and the next episode begins on a new connection, for two reasons. The server keeps
    the state of an episode with its connection. A late answer must not be mistaken for the answer to a later request.

    Args:
        address: address of the server, such as ``ws://localhost:8000``.
        timeout_s: time limit of an answer.
        look_every: number of control steps between two observations, see ``NextLook``.
        actions: action space of the server's answers, ``delta`` or ``absolute``.
        state_angle: range of the angle of the state's axis-angle, in place of the range that the server requests.

    Attributes:
        states_request: the server announces one of ``REQUESTS``, also if its value is false.

    Raises:
        PipelineError: if no server answers at the address, or if its actions cannot be executed.
    """

    def __init__(
        self,
        address: str,
        timeout_s: float = 120.0,
        look_every: int = 1,
        actions: Actions = "delta",
        state_angle: StateAngle = "server",
    ):
        try:
            from vla_eval.connection import Connection
        except ImportError as error:
            raise PipelineError(
                "the package vla-eval is not installed", remedy="pip install vla-eval==0.8.0"
            ) from error
        self.name, self._next_look, self._actions = address, NextLook(look_every), actions
        self._state_angle = state_angle
        self._loop = asyncio.new_event_loop()
        self._connection = Connection(address, timeout=timeout_s, max_retries=3)
        self._connect()
        self._announcement = self._connection.server_info
        self._seen: dict[str, Any] = {}

    def begin(self, task: EvaluationTask) -> None:
        """Begin an episode, on a new connection if the last connection failed."""
        self._next_look.left = 0
        if not self._connection.is_connected:
            self._connect()
        self._run(self._connection.start_episode({"task": task.for_harness()}), self._connection.timeout)
        self._announcement = self._connection.server_info

    def act(self, look: Look) -> Any:
        """Return the server's answer, (n, 7) or (7,), to the current or the last observation.

        Raises:
            PolicyError: if the server does not answer with actions.
        """
        if self._next_look.left == 0:
            self._seen = look(self.wanted)
        if not self._connection.is_connected:
            raise self._fault("the connection was closed")
        answer = self._run(self._connection.act(self._seen), self._connection.timeout)
        # vla-eval connects again by itself. A new connection has a new announcement, and does not know the episode.
        if self._connection.server_info is not self._announcement:
            raise self._fault("the connection was lost in the episode")
        if not isinstance(answer, dict):
            raise self._fault(f"the model server answers with {type(answer).__name__}")
        actions = answer.get("actions", answer.get("action"))
        checked_actions(actions, self.name)
        self._next_look.answered(actions)
        return actions

    def end(self, success: bool) -> None:
        """End the episode, and report its success to the server."""
        # The episode is over even if the report does not reach the server.
        with suppress(PolicyError):
            self._run(self._connection.end_episode({"metrics": {"success": success}}), self._connection.timeout)

    def close(self) -> None:
        """Close the connection."""
        self._loop.run_until_complete(self._connection.close())
        self._loop.close()

    def _connect(self) -> None:
        """Connect to the server, and read its announcement.

        Raises:
            PipelineError: if no server answers, or if its actions cannot be executed. It is no ``PolicyError``, because
                the fault concerns all episodes.
        """
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
        announced = self._connection.server_info
        wanted = announced.get("observation_params") or {}
        self.states_request = any(name in wanted for name in REQUESTS)
        try:
            reject_other_actions(wanted, announced.get("action_spec") or {}, self.name, self._actions)
        except PipelineError:
            self.close()
            raise
        shortest = is_shortest(self._state_angle, bool(wanted.get("quat_no_antipodal")))
        self.wanted = Wanted(bool(wanted.get("send_wrist_image")), bool(wanted.get("send_state")), shortest)

    def _run(self, awaited: Any, limit_s: float | None = None) -> Any:
        """Wait for a reply of the connection.

        Raises:
            PolicyError: if the reply is late or the connection fails; the connection is closed.
        """
        from websockets.exceptions import WebSocketException

        try:
            # The limit covers sending too: sending waits when the buffers of a hanging server are full.
            return self._loop.run_until_complete(asyncio.wait_for(awaited, limit_s))
        except TimeoutError as error:
            raise self._fault(f"no answer within {self._connection.timeout:g} s") from error
        except (OSError, RuntimeError, ValueError, WebSocketException) as error:
            what = str(error) or type(error).__name__
            raise self._fault(f"the model server gives no valid answer ({what})") from error

    def _fault(self, what: str) -> PolicyError:
        """Close the connection, and return an error."""
        self._loop.run_until_complete(self._connection.close())
        return PolicyError(what, where=self.name, remedy="read the server's log")


def warn_of_requests(address: str, timeout_s: float, actions: Actions, state_angle: StateAngle) -> None:
    """Log a warning if a server gets an observation that its author may not have meant.

    It may announce none of ``REQUESTS``, or get the state with angles in [0, pi] although the user did not choose this.

    Args:
        address: address of the server, such as ``ws://localhost:8000``.
        timeout_s: time limit of an answer.
        actions: the actions that the evaluation executes.
        state_angle: as ``Server``.

    Raises:
        PipelineError: as ``Server``, or if the user chose angles for a server that gets no state.
    """
    with closing(Server(address, timeout_s, actions=actions, state_angle=state_angle)) as server:
        if state_angle != "server" and not server.wanted.state:
            raise PipelineError(
                "the server does not request the state, so its angles have no effect",
                where="state_angle",
                remedy="leave --state-angle out, or return send_state from the server's get_observation_params",
            )
        if server.wanted.state and server.wanted.shortest_rotation and state_angle == "server":
            logging.getLogger(__name__).warning(
                "%s gets the state with angles in [0, pi], as it does not request quat_no_antipodal. A policy that was "
                "trained on these datasets or on LIBERO's states needs --state-angle 2pi (docs/model-server.md)",
                address,
            )
        if not server.states_request:
            logging.getLogger(__name__).warning(
                "%s announces neither %s: its policy receives only the agent view and the instruction. If the policy "
                "uses the wrist view or the state, return these parameters from get_observation_params; a value of "
                "False silences this warning (docs/model-server.md)",
                address,
                " nor ".join(REQUESTS),
            )
