"""Gymnasium environment of the tasks, with the observations and actions of lerobot 0.6's own LIBERO environment."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from pipeline import gl
from pipeline.errors import PipelineError
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings, not_begun
from pipeline.evaluation.evaluation import Evaluation
from pipeline.evaluation.policies import Wanted
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.images.jpeg import resized
from pipeline.types import Frame

CAMERAS = {"image": "agentview", "image2": "wrist"}
"""lerobot's name of a view to this project's name."""

FRAME_PX = (256, 256)
"""Height and width in which the views are rendered."""

NO_DECISION = ("device", "push_to_hub", "repo_id", "private", "tags", "license")
"""Options of a policy of lerobot that are not part of its identity, as in `evaluate`."""

Observation = dict[str, Any]


def identity_options(overrides: Sequence[str], rename_map: str | None, size_px: tuple[int, int]) -> str:
    """Return the options of lerobot-eval that change the policy or its images, as a part of the policy's identity.

    Args:
        overrides: words of the command about the policy, such as ``--n_action_steps=5``, without the folder.
        rename_map: value of that option, if it is given.
        size_px: height and width of the views.

    Returns:
        The options in alphabetical order, each after a space; empty without such options.
    """
    named: list[str] = []
    for word in overrides:
        if word.startswith("--"):
            named.append(word.removeprefix("--"))
        else:
            named[-1] += f"={word}"
    options = [f"policy.{option}" for option in named if option.partition("=")[0] not in NO_DECISION]
    if rename_map is not None:
        options.append(f"rename_map={rename_map}")
    if size_px != FRAME_PX:
        options.append(f"observation={size_px[0]}x{size_px[1]}")
    return "".join(f" {option}" for option in sorted(options))


def observation_space(size_px: tuple[int, int]) -> spaces.Dict:
    """Return the observation space.

    Args:
        size_px: height and width of the views.
    """

    def numbers(*shape: int) -> spaces.Box:
        """Return the space of unbounded numbers of a shape."""
        return spaces.Box(-np.inf, np.inf, shape, np.float64)

    image = spaces.Box(0, 255, (*size_px, 3), np.uint8)
    eef = spaces.Dict({"pos": numbers(3), "quat": numbers(4), "mat": numbers(3, 3)})
    gripper = spaces.Dict({"qpos": numbers(2), "qvel": numbers(2)})
    joints = spaces.Dict({"pos": numbers(7), "vel": numbers(7)})
    robot = spaces.Dict({"eef": eef, "gripper": gripper, "joints": joints})
    return spaces.Dict({"pixels": spaces.Dict(dict.fromkeys(CAMERAS, image)), "robot_state": robot})


class PerturbedLiberoEnv(gym.Env[Observation, np.ndarray[Any, Any]]):
    """Environment that shares a list of episodes with other environments and runs every ``stride``-th episode.

    A task has its own start, so the seed of ``reset`` has no effect.

    Args:
        tasks: all episodes, in order.
        first: index of this environment's first episode.
        stride: number of environments that share the list.
        size_px: height and width of the views; they are rendered in 256 x 256 and resized.
        evaluation: evaluation that stores the rows of episodes; `None` stores no rows.
        archive: folder of LIBERO-Plus's asset archive.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(
        self,
        tasks: Sequence[EvaluationTask],
        settings: EpisodeSettings,
        first: int = 0,
        stride: int = 1,
        size_px: tuple[int, int] = FRAME_PX,
        evaluation: Evaluation | None = None,
        archive: Path | None = None,
    ):
        self._tasks, self._next, self._stride, self._size_px = tasks, first, stride, size_px
        self._round = 0
        self._evaluation, self._environment = evaluation, EpisodeEnvironment(settings, archive)
        self._max_episode_steps = settings.step_limit(tasks[0].suite)  # required by lerobot
        self.observation_space = observation_space(size_px)
        limit = 1.0 if settings.actions == "delta" else np.inf
        self.action_space = spaces.Box(-limit, limit, (7,), np.float32)

    @property
    def task(self) -> str:
        """Return the name of the current task."""
        return self._environment.episode.task.name

    @property
    def task_description(self) -> str:
        """Return the instruction that the policy gets."""
        return self._environment.instruction

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Any]:
        """Start the next episode.

        If the episodes do not fill the last round, some environments repeat an episode. A repetition has no row.

        Raises:
            PipelineError: if no environment has an episode left, or if the scene does not settle.
        """
        super().reset(seed=seed)
        count = len(self._tasks)
        if self._round * self._stride >= count:
            raise PipelineError(
                f"lerobot requests more episodes than the {count} selected ones",
                where="eval.n_episodes",
                expected=f"--eval.n_episodes={count}",
                remedy="set this option; rows of finished episodes are kept",
            )
        self._round += 1
        self._again = self._next >= len(self._tasks)
        task = self._tasks[self._next % len(self._tasks)]
        self._next += self._stride
        gl.prepare()
        progress = self._environment.reset(task)
        if progress.over:
            raise not_begun(progress, task)
        return self._look(), {"is_success": False}

    def step(self, action: np.ndarray[Any, Any]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one control step; see ``EpisodeEnvironment``."""
        progress = self._environment.step(action)
        observation = self._look()
        limited = progress.reason == "step_limit"
        if progress.over and self._evaluation is not None and not self._again:
            self._evaluation.save(self._environment, Wanted())
        done = {"done": progress.over, "is_success": progress.success, "task": self.task}
        return observation, float(progress.success), progress.over and not limited, limited, done

    def render(self) -> Frame:
        """Return the (256, 256, 3) agent view, upright."""
        return self._environment.image("agentview")

    def close(self) -> None:
        """Close the environment."""
        self._environment.close()

    def _look(self) -> Observation:
        """Return the observation; views are upside down as LIBERO renders them, and lerobot's processor turns them."""
        self._environment.episode.looks += 1
        simulator = self._environment.simulator
        observed = simulator.observed
        upright = {name: resized(self._environment.image(view), *self._size_px) for name, view in CAMERAS.items()}
        upside_down = {name: np.ascontiguousarray(frame[::-1, ::-1]) for name, frame in upright.items()}
        w, *xyz = observed.hand_wxyz
        return {
            "pixels": upside_down,
            "robot_state": {
                "eef": {
                    "pos": observed.state[:3].astype(np.float64),
                    "quat": np.array([*xyz, w]),
                    "mat": simulator.controller.ee_ori_mat.copy(),
                },
                "gripper": {"qpos": observed.state[6:].astype(np.float64), "qvel": observed.velocity[7:]},
                "joints": {"pos": observed.joint_state.astype(np.float64), "vel": observed.velocity[:7]},
            },
        }
