"""A model server of vla-eval that replays demonstrations, except in the milk's episode, where it does as it is told."""

from __future__ import annotations

import os
from typing import Any

import anyio
from vla_eval.model_servers.base import SessionContext
from vla_eval.model_servers.serve import run_server

from pipeline.evaluation.replay_server import ReplayServer


class FaultyServer(ReplayServer):
    """Args: fault: ``hang``, ``raise`` or ``die``."""

    def __init__(self, *, fault: str):
        super().__init__(chunk=8)
        self._fault, self._faulty = fault, set[str]()

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        await super().on_episode_start(config, ctx)
        (self._faulty.add if "milk" in config["task"]["name"] else self._faulty.discard)(ctx.session_id)

    async def on_observation(self, obs: dict[str, Any], ctx: SessionContext) -> None:
        if ctx.session_id not in self._faulty:
            await super().on_observation(obs, ctx)
        elif self._fault == "hang":
            await anyio.sleep_forever()
        elif self._fault == "raise":
            raise ValueError("no such camera")
        else:
            os._exit(1)


if __name__ == "__main__":
    run_server(FaultyServer)
