"""A model server of vla-eval that replays LIBERO's demonstrations with its eyes closed: what evaluation must score.

``python -m pipeline.evaluation.replay_server --address localhost:8000 --args.chunk 8``, or ``--args.tracked true``
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from vla_eval.model_servers.base import ModelServer, SessionContext
from vla_eval.model_servers.serve import run_server
from vla_eval.specs import (
    GRIPPER_CLOSE_POS,
    IMAGE_RGB,
    POSITION_DELTA,
    ROTATION_AA,
    STATE_EEF_POS_AA_GRIP,
    DimSpec,
)

from pipeline.evaluation.replays import Replay, TrackedReplay
from pipeline.evaluation.tasks import EvaluationTask


class ReplayServer(ModelServer):  # type: ignore[misc]
    """Answers with the actions of the starter set's demonstration of the task.

    Args:
        chunk: how many actions each answer has; all are taken before the next look. Of no effect when tracked.
        tracked: follow the demonstration's path by the state in each observation, one action at a time.
    """

    def __init__(self, *, chunk: int = 1, tracked: bool = False):
        self._chunk, self._tracked = chunk, tracked
        self._replays: dict[str, Replay | TrackedReplay] = {}

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        replay = self._replays[ctx.session_id] = TrackedReplay() if self._tracked else Replay(self._chunk)
        replay.begin(EvaluationTask.of_harness(config["task"]))

    async def on_observation(self, obs: dict[str, Any], ctx: SessionContext) -> None:
        actions = self._replays[ctx.session_id].act(lambda _: obs)
        # A chunk of one is sent as one action (7,), but not the last action of a longer one: it keeps none.
        await ctx.send_action({"actions": actions.squeeze() if self._tracked or self._chunk == 1 else actions})

    def get_observation_params(self) -> dict[str, Any]:
        return {"send_state": self._tracked}

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        return {"image": IMAGE_RGB, **({"state": STATE_EEF_POS_AA_GRIP} if self._tracked else {})}


@contextmanager
def running(*program: str) -> Iterator[str]:
    """Run a model server in a process of its own; yields its address.

    Args:
        program: what Python is given: its file, or ``-m`` and its module, and its options but the address.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = subprocess.Popen([sys.executable, *program, "--address", f"127.0.0.1:{port}"])
    try:
        while server.poll() is None:
            try:
                socket.create_connection(("127.0.0.1", port)).close()
                break
            except OSError:
                time.sleep(0.1)
        yield f"ws://127.0.0.1:{port}"
    finally:
        server.terminate()
        server.wait()


def replaying(chunk: int) -> AbstractContextManager[str]:
    """Run this server in a process of its own; its address, while it is entered.

    Args:
        chunk: how many actions each answer has.
    """
    return running("-m", "pipeline.evaluation.replay_server", "--args.chunk", str(chunk))


if __name__ == "__main__":
    run_server(ReplayServer)
