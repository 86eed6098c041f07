"""Model server of vla-eval that replays demonstrations, but fails in the episodes of the milk and the plate."""

import os
from typing import Any

import anyio
from vla_eval.model_servers.base import SessionContext
from vla_eval.model_servers.serve import run_server

from pipeline.evaluation.harness import ReplayServer


class FaultyServer(ReplayServer):
    """Server that hangs in the milk's episode, or dies if ``dies`` is set, and raises an error in the plate's."""

    def __init__(self, *, dies: bool = False):
        super().__init__(chunk=8)
        self._dies = dies
        self._tasks: dict[str, str] = {}

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        await super().on_episode_start(config, ctx)
        self._tasks[ctx.session_id] = config["task"]["base"]

    async def on_observation(self, obs: dict[str, Any], ctx: SessionContext) -> None:
        task = self._tasks[ctx.session_id]
        if "plate" in task:
            raise ValueError("no such camera")
        if "milk" not in task:
            await super().on_observation(obs, ctx)
        elif self._dies:
            os._exit(1)
        else:
            await anyio.sleep_forever()


if __name__ == "__main__":
    run_server(FaultyServer)
