"""Model server that replays a demonstration, and records the observation of each computation of actions."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from vla_eval.model_servers.base import SessionContext
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import run_server

from pipeline.evaluation.reference_policies import Replay
from pipeline.evaluation.tasks import EvaluationTask


class RecordingServer(PredictModelServer):  # type: ignore[misc]
    """Server that writes a line for each computation: the control step, and the SHA-256 of the observation.

    Args:
        out: the file.
        chunk: number of actions in each computation.
        keeps: answer with one action at a time, and keep the rest of a chunk, as vla-eval's own servers do.
    """

    def __init__(self, *, out: str, chunk: int, keeps: bool):
        super().__init__(chunk_size=chunk if keeps else None)
        self._out, self._chunk = Path(out), chunk

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        await super().on_episode_start(config, ctx)
        self._replay, self._steps = Replay(self._chunk), 0
        self._replay.begin(EvaluationTask.of_harness(config["task"]))

    def predict(self, obs: dict[str, Any], ctx: SessionContext) -> dict[str, Any]:
        parts = [*(obs["images"][view] for view in sorted(obs["images"])), obs["states"]]
        observed = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
        with self._out.open("a") as out:
            out.write(json.dumps([self._steps, hashlib.sha256(observed).hexdigest()]) + "\n")
        actions = self._replay.act(lambda _: obs)
        self._steps += self._chunk
        return {"actions": actions if self._chunk > 1 else actions[0]}

    def get_observation_params(self) -> dict[str, Any]:
        return {"send_state": True, "send_wrist_image": True}


if __name__ == "__main__":
    run_server(RecordingServer)
