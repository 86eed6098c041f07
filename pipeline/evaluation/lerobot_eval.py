"""Environments for ``lerobot-eval --env.discover_packages_path=pipeline.evaluation.lerobot_eval``, of lerobot 0.6.

One vector environment per suite runs the suite's selected episodes, shared among ``--eval.batch_size`` environments.
Set ``--eval.n_episodes`` to the number of episodes, which is printed.
"""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
from lerobot.configs.types import PolicyFeature
from lerobot.envs.configs import EnvConfig, LiberoEnv

from pipeline import gl
from pipeline.errors import PipelineError
from pipeline.evaluation.environment import EpisodeSettings
from pipeline.evaluation.evaluation import Evaluation
from pipeline.evaluation.gym_environment import PerturbedLiberoEnv, identity_options
from pipeline.evaluation.policy_config import PolicyConfig
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.setting_checks import check_settings
from pipeline.evaluation.tasks import EvaluationTask

try:
    from lerobot.configs.parser import get_cli_overrides, get_path_arg, parse_arg
    from lerobot.envs.utils import freeze_after_episode_end
except ImportError as error:
    raise ImportError(
        "this lerobot cannot run these environments: use lerobot 0.6.1 with Python 3.12 or 3.13, or "
        "`python -m pipeline evaluate OUT --checkpoint DIR`"
    ) from error

__path__: list[str] = []  # lerobot searches the imported package for modules


@EnvConfig.register_subclass("perturbed_libero")
@dataclass
class PerturbedLibero(EnvConfig):  # type: ignore[misc]
    """Configuration of the environments, with the fields of ``Selection`` and ``EpisodeSettings``.

    Attributes:
        task: suites, separated by commas; ``subset`` and ``episodes`` apply to each suite.
        out, label: folder for the rows of the policy, in the format of ``evaluate``, and the policy's name there; by
            default no rows are written.
        assets: folder of LIBERO-Plus's unpacked asset archive, for its light, background and layout tasks.
    """

    task: str | None = "libero_goal"
    fps: int = 20
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)
    observation_height: int = 256
    observation_width: int = 256
    source: str = "libero"
    axes: list[str] = field(default_factory=list)
    components: list[str] = field(default_factory=list)
    levels: list[int] = field(default_factory=list)
    tasks: list[str] = field(default_factory=list)
    episodes: int = 1
    subset: int | None = None
    seed: int = 0
    prompt: str = "clean"
    step_limits: str = "openvla"
    actions: str = "delta"
    initial_states: str = "libero"
    own_step_limit: int | None = None
    demos: str | None = None
    out: str | None = None
    label: str = ""
    assets: str | None = None

    def __post_init__(self) -> None:
        theirs = self._theirs()
        self.features, self.features_map = theirs.features, theirs.features_map

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Return no arguments, because ``create_envs`` builds the environments."""
        return {}

    def get_env_processors(self) -> Any:
        """Return the processors of lerobot's own LIBERO environment."""
        return self._theirs().get_env_processors()

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Return suite to 0 to the vector environment of all the suite's episodes.

        Raises:
            PipelineError: if a setting is rejected.
        """
        if self.source not in ("libero", "libero_plus", "goals"):
            raise PipelineError(f"no source {self.source!r}", where="env.source", expected="libero, libero_plus, goals")
        if self.max_parallel_tasks > 1:
            raise PipelineError(
                "parallel suites would share one policy, which stores the actions of one batch",
                where="env.max_parallel_tasks",
                expected="1",
                remedy="set --eval.batch_size to run several episodes at the same time",
            )
        settings_named = ("prompt", "seed", "step_limits", "actions", "initial_states", "own_step_limit", "demos")
        given = {name: getattr(self, name) for name in settings_named}
        settings = EpisodeSettings.model_validate({**given, "runner": "lerobot-eval"})
        archive = None if self.assets is None else Path(self.assets)
        evaluation = self._evaluation(settings, archive)
        size_px = self.observation_height, self.observation_width
        tasks: dict[str, list[EvaluationTask]] = {}
        for suite in (self.task or "").split(","):
            named = ("source", "axes", "components", "levels", "tasks", "episodes", "subset", "seed")
            chosen = {"suites": (suite.strip(),), **{name: getattr(self, name) for name in named}}
            selection = Selection.model_validate(chosen)
            # Sorted by scene, so that each scene is built once.
            tasks[suite.strip()] = sorted(select(selection, archive), key=lambda task: (task.base, task.name))
        every_task: list[EvaluationTask] = []
        for suite_tasks in tasks.values():
            every_task += suite_tasks
        check_settings(selection, every_task, settings)
        counts = {suite: len(suite_tasks) for suite, suite_tasks in tasks.items()}
        if len({*counts.values()}) > 1:
            raise PipelineError(
                "--eval.n_episodes is one number, and the suites have different numbers of episodes: "
                f"{', '.join(f'{suite} {number}' for suite, number in counts.items())}",
                where="env.task",
                expected="suites with equal numbers of episodes",
                remedy="evaluate each suite by its own command, with the same --env.out; or set --env.subset",
            )
        if evaluation is not None:
            evaluation.check(every_task)
        print(gl.choose())  # before the worker processes start, because they inherit the choice
        vector_environments: dict[str, dict[int, gym.vector.VectorEnv]] = {}
        for suite, suite_tasks in tasks.items():
            count = len(suite_tasks)
            print(f"{suite}: {count} episodes; --eval.n_episodes={count} runs each of them once")
            makers = []
            for first in range(n_envs):
                maker = partial(PerturbedLiberoEnv, suite_tasks, settings, first, n_envs, size_px, evaluation, archive)
                # An environment that is done waits until all environments are done.
                makers.append(freeze_after_episode_end(maker))
            vectorise: Any = gym.vector.SyncVectorEnv
            if use_async_envs and n_envs > 1:
                vectorise = partial(gym.vector.AsyncVectorEnv, context="forkserver")
            vector_environments[suite] = {0: vectorise(makers, autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP)}
        return vector_environments

    def _theirs(self) -> Any:
        """Return the configuration of lerobot's own LIBERO environment."""
        return LiberoEnv(observation_height=self.observation_height, observation_width=self.observation_width)

    def _evaluation(self, settings: EpisodeSettings, archive: Path | None) -> Evaluation | None:
        """Return the evaluation that stores rows under the identity of lerobot's policy; `None` without ``out``.

        Raises:
            PipelineError: if the policy is not a local folder.
        """
        if self.out is None:
            return None
        folder = get_path_arg("policy")
        if folder is None or not Path(folder).is_dir():
            raise PipelineError(
                f"rows identify a policy by the content of its files, but {folder} is no folder",
                where="policy.path",
                expected="a folder that lerobot saved a policy in",
                remedy="run `hf download REPOSITORY --local-dir DIR`, then set --policy.path=DIR",
            )
        policy = PolicyConfig(kind="checkpoint", address=folder, label=self.label)
        size_px = self.observation_height, self.observation_width
        options = identity_options(get_cli_overrides("policy") or (), parse_arg("rename_map"), size_px)
        return Evaluation(settings, policy, policy.identity() + options, Path(self.out), archive=archive)
