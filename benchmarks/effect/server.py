"""Model server of vla-eval for a policy of this experiment, with stored embeddings instead of a language model.

python benchmarks/effect/server.py --args.folder data/effect/policies/clean_seed0_... --address 127.0.0.1:8000
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import sentences
import torch
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from numpy.typing import NDArray
from states import relative
from training import IMAGES, PROPRIOCEPTION, SENTENCE, STATE, pixels
from vla_eval.model_servers.base import ModelServer, SessionContext
from vla_eval.model_servers.serve import run_server
from vla_eval.specs import IMAGE_RGB, LANGUAGE, STATE_EEF_POS_AA_GRIP, DimSpec

from pipeline.evaluation.harness import ACTION
from pipeline.evaluation.policies import VIEWS
from pipeline.images.jpeg import resized
from pipeline.machine_code import ensure_fixed_machine_code


class SentenceServer(ModelServer):  # type: ignore[misc]
    """Server that answers with the first ``n_action_steps`` of a chunk; all are taken before the next observation.

    Args:
        folder: folder of the policy.
    """

    def __init__(self, *, folder: str):
        torch.set_num_threads(1)
        self._policy = ACTPolicy.from_pretrained(folder)
        self._policy.eval()
        self._before, self._after = make_pre_post_processors(self._policy.config, folder)
        self._vectors = sentences.read()
        self._is_relative = json.loads((Path(folder) / PROPRIOCEPTION).read_text()) == "relative"
        self._first: dict[str, NDArray[np.float32]] = {}

    async def on_observation(self, obs: dict[str, Any], ctx: SessionContext) -> None:
        size = self._policy.config.image_features[IMAGES["image"]].shape[1:]
        batch = {IMAGES[VIEWS[view]]: pixels(resized(frame, *size)[None]) for view, frame in obs["images"].items()}
        batch[STATE] = torch.from_numpy(self._state(obs["states"], ctx))[None]
        batch[SENTENCE] = torch.from_numpy(sentences.vector(obs["task_description"], self._vectors))[None]
        with torch.inference_mode():
            chunk = self._policy.predict_action_chunk(self._before(batch))
        await ctx.send_action({"actions": self._after(chunk)[0, : self._policy.config.n_action_steps].numpy()})

    def _state(self, state: NDArray[np.float32], ctx: SessionContext) -> NDArray[np.float32]:
        """Return the state (8,) that the policy was trained with."""
        if not self._is_relative:
            return np.array(state)
        if ctx.is_first:
            self._first[ctx.session_id] = np.array(state)
        return np.asarray(relative(state[None], self._first[ctx.session_id])[0])

    def get_observation_params(self) -> dict[str, Any]:
        return {"send_wrist_image": True, "send_state": True, "quat_no_antipodal": True}

    def get_action_spec(self) -> dict[str, DimSpec]:
        return ACTION

    def get_observation_spec(self) -> dict[str, DimSpec]:
        return {"image": IMAGE_RGB, "wrist": IMAGE_RGB, "state": STATE_EEF_POS_AA_GRIP, "language": LANGUAGE}


if __name__ == "__main__":
    ensure_fixed_machine_code()
    run_server(SentenceServer)
