"""Policy of lerobot 0.6 that repeats recorded deltas or goals, to check ``--env.actions`` of lerobot-eval.

The script records both with this project on Python 3.12 or 3.13. A scripted policy follows the task's demonstration
from LIBERO's first initial state, and must succeed. OUT/delta has its actions, OUT/absolute the goals that they set for
the controller:

    python benchmarks/clients/replay_policy.py libero_goal turn_on_the_stove OUT

Then stock lerobot-eval runs either policy in the same episode, after the ``export`` lines of ``docs/evaluation.md``:

    export PYTHONPATH=.:benchmarks/clients
    lerobot-eval --env.discover_packages_path=replay_policy --env.type=perturbed_libero \
        --policy.path=OUT/absolute --env.actions=absolute \
        --env.task=libero_goal --env.tasks='[turn_on_the_stove]' --eval.n_episodes=1 --eval.batch_size=1
"""

import sys
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.pretrained import PreTrainedPolicy

import pipeline.evaluation.lerobot_eval  # noqa: F401  # registers the environments

__path__: list[str] = []  # lerobot searches the imported package for modules


@PreTrainedConfig.register_subclass("replay")
@dataclass
class ReplayConfig(PreTrainedConfig):  # type: ignore[misc]
    """Number of recorded actions; lerobot finds the class ``ReplayPolicy`` by this class's name."""

    steps: int = 1
    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=dict)
    observation_delta_indices = None
    action_delta_indices = None
    reward_delta_indices = None

    def get_optimizer_preset(self) -> Any:
        raise NotImplementedError

    def get_scheduler_preset(self) -> None:
        return None

    def validate_features(self) -> None:
        """Accept any observation, because the policy uses none."""


class ReplayPolicy(PreTrainedPolicy):  # type: ignore[misc]
    """Policy that repeats recorded actions, whatever it observes."""

    config_class = ReplayConfig
    name = "replay"
    actions: torch.Tensor

    def __init__(self, config: ReplayConfig, **_: Any):
        super().__init__(config)
        self.register_buffer("actions", torch.zeros(config.steps, 7))
        self.reset()

    def reset(self) -> None:
        self._taken = 0

    def select_action(self, batch: dict[str, Any], **_: Any) -> torch.Tensor:
        """Return the next action for all environments, and the last action after the end."""
        action = self.actions[min(self._taken, len(self.actions) - 1)]
        self._taken += 1
        return action.expand(len(batch["observation.state"]), -1)

    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> torch.Tensor:
        raise NotImplementedError

    def forward(self, batch: dict[str, Any]) -> Any:
        raise NotImplementedError

    def get_optim_params(self) -> dict[str, Any]:
        raise NotImplementedError


def save(folder: Path, actions: Any) -> None:
    """Save a policy that repeats actions (T, 7), with processors that change no number."""
    from lerobot.processor import make_default_pre_post_processors

    config = ReplayConfig(
        steps=len(actions),
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (8,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        device="cpu",
        push_to_hub=False,
    )
    policy = ReplayPolicy(config)
    policy.actions.copy_(torch.from_numpy(np.asarray(actions, np.float32)))
    for part in (policy, *make_default_pre_post_processors(config, None)):
        part.save_pretrained(folder)


def record(suite: str, name: str) -> tuple[Any, Any]:
    """Return the deltas and the goals, each (T, 7), of an episode in which the scripted policy succeeds."""
    from scipy.spatial.transform import Rotation

    from pipeline.evaluation.environment import EpisodeEnvironment
    from pipeline.evaluation.reference_policies import TrackedReplay
    from pipeline.evaluation.selection import Selection, select

    (task,) = select(Selection(suites=(suite,), tasks=(name,), episodes=1))
    policy, deltas, goals = TrackedReplay(), [], []
    with closing(EpisodeEnvironment()) as environment:
        environment.reset(task)
        policy.begin(task)
        while not environment.progress.over:
            delta = policy.act(environment.observation)
            environment.step(delta)
            controller = environment.simulator.controller
            axis_angle = Rotation.from_matrix(controller.goal_ori).as_rotvec()
            deltas.append(delta)
            goals.append(np.hstack([controller.goal_pos, axis_angle, delta[6]]))
        print(f"{suite}/{name}: {environment.progress}")
        assert environment.progress.success
    return np.stack(deltas), np.stack(goals)


def main() -> None:
    from pipeline.machine_code import ensure_fixed_machine_code

    ensure_fixed_machine_code()
    suite, name, out = sys.argv[1:]
    deltas, goals = record(suite, name)
    save(Path(out) / "delta", deltas)
    save(Path(out) / "absolute", goals)


if __name__ == "__main__":
    main()
