"""What acts: the questions that a policy is asked, and policies behind a model server or in a lerobot checkpoint."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.evaluation.actions import PolicyError, checked_actions, refuse_other_actions
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.files import checksum
from pipeline.images.jpeg import resized
from pipeline.seeding import digest
from pipeline.types import Floats

VIEWS = {"agentview": "image", "wrist": "wrist_image"}
"""What policies call the views, to their names in ``schemas/episode.json``."""


class Wanted(NamedTuple):
    """What a policy asks to see.

    Attributes:
        state: position, axis-angle and fingers.
        shortest_rotation: the axis-angle with an angle in [0, pi], as vla-eval has it by default; else in [0, 2 pi], as
            robosuite and OpenVLA's data have it.
        images: any view at all; without them nothing is rendered.
    """

    wrist: bool = True
    state: bool = True
    shortest_rotation: bool = False
    images: bool = True


Look = Callable[[Wanted], dict[str, Any]]
"""Gives the observation; frames are rendered when it is called."""


class Policy(Protocol):
    """Asked for actions until the episode is over."""

    name: str
    wanted: Wanted
    """What it looks at."""

    def begin(self, task: EvaluationTask) -> None:
        """An episode begins."""

    def act(self, look: Look) -> Any:
        """The actions to take next, (n, 7) or (7,) for one, as ``checked_actions`` takes them; looks only when it has
        to.

        Raises:
            PolicyError: when there is no answer.
        """

    def end(self, success: bool) -> None:
        """It is over."""


class NextLook:
    """When a model server has to be shown the scene anew.

    A server that answers with a chunk (n, 7) computes its next answer when those actions are taken, from what it is
    shown then. One that answers with a single action (7,) may have taken it from a chunk that it keeps, which nobody
    but itself knows; it is shown the scene once in ``every`` control steps.
    """

    def __init__(self, every: int):
        self._every = every
        self.left = 0
        """Actions that are taken before the next look, which is due at 0, as when an episode begins."""

    def answered(self, actions: Any) -> None:
        """Args: actions: (n, 7) or (7,), all of which are taken before the next question."""
        self.left = (self.left or self._every) - 1 if np.ndim(actions) == 1 else 0


class Server:
    """A model server of vla-eval. It is asked at every step, or, where it answers with a chunk, once in a chunk.

    A connection that failed is closed, and the next episode begins on a new one: the server keeps the state of an
    episode with its connection, and an answer that comes late must not be taken for that to a later question.

    Args:
        address: such as ``ws://localhost:8000``.

    Raises:
        PipelineError: when no server answers there, or its actions cannot be executed.
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
        self._next_look.left = 0
        if not self._connection.is_connected:
            self._connect()
        self._run(self._connection.start_episode({"task": task.for_harness()}), self._connection.timeout)

    def act(self, look: Look) -> Any:
        if self._next_look.left == 0:
            self._seen = look(self.wanted)
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
        """Raises: PipelineError: when no server answers, or with other actions: not the fault of one episode."""
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
        try:
            refuse_other_actions(wanted, announced.get("action_spec") or {}, self.name)
        except PipelineError:
            self.close()
            raise
        self.wanted = Wanted(
            bool(wanted.get("send_wrist_image")), bool(wanted.get("send_state")), not wanted.get("quat_no_antipodal")
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
        if unknown := ", ".join(key for key in config.image_features if key not in cameras):
            raise PipelineError(f"the policy wants the images {unknown}", where=folder, expected=", ".join(cameras))
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
        return np.asarray(actions.cpu().numpy(), np.float64)

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
    return digest(
        {
            name.as_posix(): checksum(path)
            for name, path in inside.items()
            if name.name not in BESIDE and not any(part.startswith(".") for part in name.parts)
        }
    )
