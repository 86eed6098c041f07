"""Policies in a checkpoint of lerobot."""

import logging
from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.evaluation.policies import VIEWS, Look, Wanted
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.files import checksum, read_json
from pipeline.images.jpeg import resized
from pipeline.seeding import digest
from pipeline.types import Floats


class Camera(NamedTuple):
    """Image that a checkpoint gets.

    Attributes:
        view: name of the view for policies, see ``VIEWS``.
        size_px: height and width of the frames that the policy was trained on.
    """

    view: str
    size_px: tuple[int, int]


def cameras_of(config: Any, renamed: Mapping[str, str], folder: Path) -> dict[str, Camera]:
    """Map the key of each image that a policy gets, as in the datasets, to its camera.

    A policy with ``empty_cameras``, such as SmolVLA and pi0.5, acts without some of its images if it gets both views. A
    warning names these images.

    Args:
        config: lerobot's configuration of the policy.
        renamed: key of the datasets to the policy's own key, as the policy's processor renames observations.
        folder: folder of the policy, for error messages.

    Raises:
        PipelineError: if the policy needs an image that the tasks do not have.
    """
    wanted, cameras = dict(config.image_features), {}
    offered = {SCHEMA.views[view].lerobot_key: name for name, view in VIEWS.items()}
    for key, view in offered.items():
        feature = wanted.pop(renamed.get(key, key), None)
        if feature is not None:
            _, height, width = feature.shape
            cameras[key] = Camera(view, (height, width))
    if wanted and not (len(cameras) == len(offered) and hasattr(config, "empty_cameras")):
        raise PipelineError(
            f"the policy needs the images {', '.join(wanted)}, which the tasks do not have",
            where=folder,
            expected=", ".join(offered),
            remedy="train with lerobot's --rename_map, which the checkpoint keeps",
        )
    unfed = [key for key in wanted if "empty_camera" not in key]
    if unfed:
        logging.getLogger(__name__).warning(
            "the tasks have no image for %s, so %s acts without it", " and ".join(unfed), folder
        )
    return cameras


def warn_of_inverted_gripper(processor: Any, folder: Path) -> None:
    """Log a warning if a policy was trained on gripper commands from 0 to 1, and returns them.

    LIBERO's commands are -1 (open) and 1 (closed). In IPEC's convention 0 is closed and 1 is open, so that the hand
    would close in place of opening.

    Args:
        processor: lerobot's postprocessor of the policy.
        folder: folder of the policy, for the message.
    """
    from lerobot.processor.normalize_processor import UnnormalizerProcessorStep

    for step in processor.steps:
        if isinstance(step, UnnormalizerProcessorStep):
            least = (step.stats or {}).get("action", {}).get("min")
            if least is not None and np.ravel(least)[-1] >= 0:
                logging.getLogger(__name__).warning(
                    "%s was trained on gripper commands from 0 to 1. LIBERO's are -1 (open) and 1 (closed): unless the "
                    "policy converts them, train on export.lerobot.convention: libero",
                    folder,
                )


def _renamed(processor: Any) -> dict[str, str]:
    """Return the keys of observations that a policy's processor renames, and their new names."""
    from lerobot.processor.rename_processor import RenameObservationsProcessorStep

    renamed: dict[str, str] = {}
    for step in processor.steps:
        if isinstance(step, RenameObservationsProcessorStep):
            renamed |= step.rename_map
    return renamed


class Checkpoint:
    """Policy that lerobot saved, run in this process.

    If the policy predicts chunks, it is asked for chunks, so that it observes once per ``n_action_steps``. Frames are
    resized to the size of its training frames. Random numbers, such as those of a diffusion policy, depend on the task
    alone.

    Args:
        folder: folder with ``config.json`` and the weights, such as ``outputs/train/.../pretrained_model``.

    Raises:
        PipelineError: if the policy wants an image that the tasks do not have, if its weights were not loaded, or if
            its packages are missing. Also if its folder names code of other packages.
    """

    wanted = Wanted()

    def __init__(self, folder: Path):
        # lerobot and its models take seconds to import.
        import torch
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        self.name, self._torch = str(folder), torch
        config = _config_of(folder, PreTrainedConfig)
        config.pretrained_path = folder
        if config.device is None or (config.device.startswith("cuda") and not torch.cuda.is_available()):
            config.device = "cpu"
        weights = _weights_of(folder)
        try:
            self._policy = get_policy_class(config.type).from_pretrained(folder, config=config)
        except (ImportError, TypeError) as error:
            # lerobot's policies replace the names of a missing package by None, which then cannot be called.
            if isinstance(error, TypeError) and "NoneType" not in str(error):
                raise
            raise _cannot_load(folder, config.type, str(error), "the packages that the policy needs") from error
        _reject_other_weights(self._policy.state_dict(), weights)
        self._policy.eval()
        _reject_foreign_steps(folder)
        self._before, self._after = make_pre_post_processors(
            config, str(folder), preprocessor_overrides={"device_processor": {"device": config.device}}
        )
        warn_of_inverted_gripper(self._after, folder)
        self._cameras = cameras_of(config, _renamed(self._before), folder)
        chunked = getattr(config, "n_obs_steps", 1) == 1 and getattr(config, "temporal_ensemble_coeff", None) is None
        self._chunk = int(getattr(config, "n_action_steps", 1)) if chunked else 1

    def begin(self, task: EvaluationTask) -> None:
        """Begin an episode, with random numbers that depend on the task."""
        # lerobot's policies use no other generator.
        self._torch.manual_seed(int(digest("policy", str(task))[:15], 16))
        self._policy.reset()

    def act(self, look: Look) -> Floats:
        """Return the policy's actions for a new observation, (n, 7); n is 1 without chunks."""
        observation = look(self.wanted)
        batch: dict[str, Any] = {}
        for key, camera in self._cameras.items():
            frame = resized(observation["images"][camera.view], *camera.size_px)
            batch[key] = self._torch.from_numpy(frame).permute(2, 0, 1)[None].float() / 255
        batch["observation.state"] = self._torch.from_numpy(observation["states"])[None]
        batch["task"] = [observation["task_description"]]
        with self._torch.inference_mode():
            batch = self._before(batch)
            if self._chunk == 1:
                actions = self._policy.select_action(batch)
            else:
                actions = self._policy.predict_action_chunk(batch)[0, : self._chunk]
            actions = self._after(actions)
        return np.asarray(actions.cpu().numpy(), np.float64)

    def end(self, success: bool) -> None:
        """End the episode, without effect on the policy."""


def _config_of(folder: Path, configs: Any) -> Any:
    """Read lerobot's configuration of a policy; ``configs`` is its base class.

    Raises:
        PipelineError: if the installed lerobot does not have this type of policy.
    """
    kind = str(read_json(folder / "config.json", "name a folder that lerobot saved a policy in").get("type"))
    if kind not in configs.get_known_choices():
        installed = f"lerobot {version('lerobot')} has no policy of this type"
        raise _cannot_load(folder, kind, installed, "a policy of the installed lerobot")
    return configs.from_pretrained(folder)


def _cannot_load(folder: Path, kind: str, what: str, expected: str) -> PipelineError:
    """Return the error about a policy that this environment cannot load, and another one can serve."""
    return PipelineError(
        f"lerobot cannot load a policy of the type {kind}: {what}",
        where=folder,
        expected=expected,
        remedy="serve the policy from the environment that trained it, after `pip install vla-eval==0.8.0` there: "
        f"`python -m vla_eval.model_servers.lerobot --args.policy_type {kind} --args.checkpoint {folder} "
        "--args.chunk_size N`, then `evaluate --server ... --look-every N --state-angle 2pi`",
    )


def _reject_foreign_steps(folder: Path) -> None:
    """Raise a ``PipelineError`` if a checkpoint names a foreign step, which lerobot would import and call."""
    for file in sorted(folder.glob("policy_*processor.json")):
        for step in read_json(file, "name a folder that lerobot saved a policy in").get("steps", []):
            if not _is_of_lerobot(step):
                raise PipelineError(
                    f"{step!s:.200} is not a step of lerobot, and lerobot would import and call it",
                    where=file,
                    expected="steps of lerobot",
                    remedy="if you trust this code, serve the policy (docs/model-server.md)",
                )


def _is_of_lerobot(step: Any) -> bool:
    """Return whether a step has a registered name or names a class of lerobot for steps."""
    from lerobot.processor import ProcessorStep

    if not isinstance(step, dict):
        return False
    if "registry_name" in step:
        return True
    module, _, name = str(step.get("class")).rpartition(".")
    if not module.startswith("lerobot."):
        return False
    try:
        found = getattr(import_module(module), name, None)
    except ImportError:
        return False
    return isinstance(found, type) and issubclass(found, ProcessorStep)


COMPARED_TENSORS = 20
"""Number of a checkpoint's tensors that are compared with those of the loaded policy."""


def _weights_of(folder: Path) -> Path:
    """Return the file of a checkpoint's weights.

    Raises:
        PipelineError: if there is no such file.
    """
    file = folder / "model.safetensors"
    if not file.is_file():
        raise PipelineError(
            "the checkpoint has no weights of its own",
            where=file,
            expected="the weights in one file; an adapter alone is not loaded",
            remedy="merge the adapter (LoRA) into the weights, and save the policy",
        )
    return file


def _reject_other_weights(loaded: Mapping[str, Any], file: Path) -> None:
    """Compare some tensors of the loaded policy, evenly chosen by name, with those of the checkpoint.

    lerobot's pi0.5 prints a line and keeps random weights if it fails to load them (huggingface/lerobot#4577).

    Raises:
        PipelineError: if no tensor of the checkpoint is in the policy, or one differs.
    """
    from safetensors import safe_open

    with safe_open(file, "pt") as weights:
        names = sorted(loaded.keys() & {*weights.keys()})
        chosen = names[:: max(1, len(names) // COMPARED_TENSORS)]
        differing = [name for name in chosen if not _is_loaded(loaded[name], weights.get_tensor(name))]
    if not chosen or differing:
        raise PipelineError(
            f"lerobot did not load the weights ({differing[0] if chosen else 'no name in common'})",
            where=file,
            expected="a policy with the tensors of the checkpoint",
            remedy="evaluate with the version of lerobot that trained it, and read its output",
        )


def _is_loaded(tensor: Any, stored: Any) -> bool:
    """Return whether a policy's tensor has the stored values, in its own type."""
    return bool(tensor.shape == stored.shape and (tensor.cpu() == stored.to(tensor.dtype)).all())


WITHOUT_EFFECT = ("train_config.json", "README.md")
"""Files of a checkpoint that do not affect its actions."""


def content_of(checkpoint: Path) -> str:
    """Compute a digest of a checkpoint: the names and SHA-256 sums of the files in its folder.

    The digest includes configuration, weights, processors and other files, but not ``WITHOUT_EFFECT`` and hidden
    files. It does not include files that lerobot loads from other places, such as a tokenizer.

    Raises:
        PipelineError: if the folder is not a checkpoint.
    """
    if not (checkpoint / "config.json").is_file():
        raise PipelineError(
            "the folder has no config.json",
            where=checkpoint,
            expected="a folder that lerobot saved a policy in",
            remedy="name the folder pretrained_model of a checkpoint",
        )
    checksums: dict[str, str] = {}
    for path in checkpoint.rglob("*"):
        name = path.relative_to(checkpoint)
        hidden = any(part.startswith(".") for part in name.parts)
        if path.is_file() and not hidden and name.name not in WITHOUT_EFFECT:
            checksums[name.as_posix()] = checksum(path)
    return digest(checksums)
