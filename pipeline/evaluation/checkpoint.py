"""A lerobot checkpoint on disk as a policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.evaluation.settings import VIEWS, Look, Wanted
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.files import checksum
from pipeline.images.jpeg import resized
from pipeline.seeding import digest
from pipeline.types import Floats


class Checkpoint:
    """A policy that lerobot saved, run in this process.

    It is asked for a chunk where it makes chunks, so that it looks once in ``n_action_steps``. Frames get the size of
    those that it was trained on. Random numbers, such as a diffusion policy draws, follow from the task alone.

    Args:
        folder: with ``config.json`` and the weights, such as ``outputs/train/.../pretrained_model``.
    """

    wanted = Wanted()

    def __init__(self, folder: Path):
        # lerobot and its models take seconds to import.
        import torch
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        self.name, self._torch = str(folder), torch
        config = PreTrainedConfig.from_pretrained(folder)
        config.pretrained_path = folder
        if config.device is None or (config.device.startswith("cuda") and not torch.cuda.is_available()):
            config.device = "cpu"
        self._policy = get_policy_class(config.type).from_pretrained(folder, config=config)
        self._policy.eval()
        self._before, self._after = make_pre_post_processors(
            config, str(folder), preprocessor_overrides={"device_processor": {"device": config.device}}
        )
        cameras = {SCHEMA.views[view].lerobot_key: name for name, view in VIEWS.items()}
        unknown = [key for key in config.image_features if key not in cameras]
        if unknown:
            raise PipelineError(
                f"the policy wants the images {', '.join(unknown)}", where=folder, expected=", ".join(cameras)
            )
        self._cameras = {key: name for key, name in cameras.items() if key in config.image_features}
        self._sizes_px = {key: config.image_features[key].shape[1:] for key in self._cameras}
        chunked = getattr(config, "n_obs_steps", 1) == 1 and getattr(config, "temporal_ensemble_coeff", None) is None
        self._chunk = int(getattr(config, "n_action_steps", 1)) if chunked else 1

    def begin(self, task: EvaluationTask) -> None:
        # lerobot's policies draw from this generator alone.
        self._torch.manual_seed(int(digest("policy", str(task))[:15], 16))
        self._policy.reset()

    def act(self, look: Look) -> Floats:
        seen = look(self.wanted)
        batch: dict[str, Any] = {}
        for key, name in self._cameras.items():
            frame = resized(seen["images"][name], *self._sizes_px[key])
            batch[key] = self._torch.from_numpy(frame).permute(2, 0, 1)[None].float() / 255
        batch["observation.state"] = self._torch.from_numpy(seen["states"])[None]
        batch["task"] = [seen["task_description"]]
        with self._torch.inference_mode():
            batch = self._before(batch)
            if self._chunk == 1:
                actions = self._policy.select_action(batch)
            else:
                actions = self._policy.predict_action_chunk(batch)[0, : self._chunk]
            actions = self._after(actions)
        taken: Floats = np.asarray(actions.cpu().numpy(), np.float64)
        return taken

    def end(self, success: bool) -> None: ...


BESIDE = ("train_config.json", "README.md")
"""Files of a checkpoint that do not decide what it does."""


def content_of(checkpoint: Path) -> str:
    """SHA-256 of the files in a checkpoint's folder, by their names: configuration, weights, processors and whatever
    else is there but ``BESIDE`` and hidden files. What lerobot loads from elsewhere, such as a tokenizer, is not in it.

    Raises:
        PipelineError: when it is no checkpoint.
    """
    if not (checkpoint / "config.json").is_file():
        raise PipelineError("no config.json", where=checkpoint, expected="a folder that lerobot saved a policy in")
    inside = {path.relative_to(checkpoint): path for path in checkpoint.rglob("*") if path.is_file()}
    deciding = {
        name.as_posix(): path
        for name, path in inside.items()
        if name.name not in BESIDE and not any(part.startswith(".") for part in name.parts)
    }
    return digest({name: checksum(path) for name, path in deciding.items()})
