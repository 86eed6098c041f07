"""Benchmark for vla-eval, the field's harness.

``vla-eval run`` evaluates any of vla-eval's model servers on the tasks. Its configuration names
``pipeline.evaluation.harness:PerturbedLibero``.
"""

from pathlib import Path
from typing import Any, ClassVar

from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.model_servers.base import ModelServer, SessionContext
from vla_eval.model_servers.serve import run_server
from vla_eval.specs import (
    GRIPPER_CLOSE_POS,
    IMAGE_RGB,
    LANGUAGE,
    POSITION_ABSOLUTE,
    POSITION_DELTA,
    ROTATION_AA,
    STATE_EEF_POS_AA_GRIP,
    DimSpec,
)

from pipeline import gl
from pipeline.errors import PipelineError
from pipeline.evaluation.actions import checked_actions, reject_other_actions
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings, not_begun
from pipeline.evaluation.evaluation import Evaluation
from pipeline.evaluation.goals import leave_out_trained_goals
from pipeline.evaluation.model_server import NextLook
from pipeline.evaluation.policies import Wanted, is_shortest
from pipeline.evaluation.policy_config import PolicyConfig
from pipeline.evaluation.reference_policies import Replay, TrackedReplay
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.setting_checks import check_settings
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.tasks import SUITES, suites
from pipeline.machine_code import ensure_fixed_machine_code

ACTION = {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}


class PerturbedLibero(StepBenchmark):  # type: ignore[misc]
    """Benchmark of LIBERO's tasks, LIBERO-Plus's test tasks, or held-out perturbations, chosen by a ``Selection``.

    ``episodes_per_task`` of the harness stays 1. Each initial state and each perturbation is a separate task, and
    ``selection.episodes`` sets their number.

    Args:
        selection: fields of ``Selection``, such as ``{"source": "libero_plus", "axes": ["camera"], "subset": 100}``.
        settings: fields of ``EpisodeSettings``, such as ``{"prompt": "benchmark"}``; the seed is the selection's.
        look_every: number of control steps between two observations of a server that answers with single actions from
            a chunk of its own: the number of actions that it takes from a chunk. In between, the last observation is
            sent again and nothing is rendered. 1 renders every step. After an answer that is a chunk, a new observation
            is always rendered.
        send_wrist_image, send_state, quat_no_antipodal: content of the observation, in the names of vla-eval's own
            LIBERO benchmark. vla-eval's model servers set these arguments.
        absolute_action: argument of vla-eval's LIBERO benchmark; true requires the setting `actions: absolute`.
        env_seed: argument of vla-eval's LIBERO benchmark: seed of LIBERO's reset.
        out, label: folder for the rows of the policy, in the format of ``evaluate``, and the policy's name there; by
            default no rows are written.
        assets: folder of LIBERO-Plus's unpacked asset archive, for its light, background and layout tasks.
        seed: argument of vla-eval's LIBERO benchmark; without effect, because the tasks use no global generator.
    """

    render_backends: ClassVar[frozenset[str]] = frozenset({"gpu", "cpu"})

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Choose OpenGL as this project does, which respects ``MUJOCO_GL`` if it is set."""
        choice = gl.choose()
        print(choice)
        return {"MUJOCO_GL": choice.backend}

    def __init__(
        self,
        selection: dict[str, Any] | None = None,
        settings: dict[str, Any] | None = None,
        look_every: int = 1,
        send_wrist_image: bool = False,
        send_state: bool = False,
        quat_no_antipodal: bool = False,
        absolute_action: bool = False,
        env_seed: int | None = None,
        out: str | None = None,
        label: str = "",
        assets: str | None = None,
        seed: int | None = None,
    ):
        super().__init__()
        del seed
        self._selection = Selection.model_validate(selection or {})
        given = {"seed": self._selection.seed, "look_every": look_every}
        given |= {} if env_seed is None else {"fixture_seed": env_seed}
        self._archive = None if assets is None else Path(assets)
        episodes = EpisodeSettings.model_validate(given | (settings or {}))
        reject_other_actions({"absolute_action": absolute_action}, {}, "model server", episodes.actions)
        self._environment = EpisodeEnvironment(episodes, self._archive)
        self._evaluation: Evaluation | None = None
        if out is not None:
            policy = PolicyConfig(kind="server", address="of the harness", label=label)
            self._evaluation = Evaluation(episodes, policy, policy.identity(), Path(out), archive=self._archive)
        elif label:
            raise PipelineError(
                f"there is no folder for the rows of {label!r}",
                where="label",
                remedy="set out: DIR in addition to label",
            )
        self._next_look = NextLook(self._environment.settings.look_every)
        self._wanted = Wanted(send_wrist_image, send_state, is_shortest(episodes.state_angle, quat_no_antipodal))

    def get_tasks(self) -> list[dict[str, Any]]:
        """Return one task per episode; ``name`` is unique, ``suite`` is LIBERO's."""
        settings = self._environment.settings
        tasks = leave_out_trained_goals(select(self._selection, self._archive), settings.plan)
        check_settings(self._selection, tasks, settings)
        if self._evaluation is not None:
            self._evaluation.check(tasks)
        return [task.for_harness() for task in tasks]

    def reset(self, task: dict[str, Any]) -> Any:
        """Start an episode and return its first observation.

        Raises:
            PipelineError: if the scene rejects the perturbation or does not settle.
        """
        wanted = EvaluationTask.of_harness(task)
        progress = self._environment.reset(wanted)
        if progress.over:
            self._save()
            raise not_begun(progress, wanted)
        self._next_look.left = 0
        return self._look()

    def step(self, action: dict[str, Any]) -> StepResult:
        """Take one action (7,), or all of a chunk (n, 7) until the episode is over."""
        given = action.get("actions", action.get("action"))
        for single_action in checked_actions(given, "model server"):
            progress = self._environment.step(single_action)
            if progress.over:
                break
        self._next_look.answered(given)
        if self._next_look.left == 0 and not progress.over:
            self._look()
        return StepResult(self._last, float(progress.success), progress.over, {"success": progress.success})

    def make_obs(self, raw_obs: Any, task: dict[str, Any]) -> dict[str, Any]:
        """Return the observation as the model server gets it."""
        return dict(raw_obs)

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """Store the episode's row if rows are wanted, and return its result.

        Raises:
            PipelineError: if rows are wanted but the harness ended the episode before its limit.
        """
        progress = self._environment.progress
        if self._evaluation is not None and not progress.over:
            limit = self._environment.episode.step_limit
            raise PipelineError(
                f"the harness ended this episode after {progress.steps} of {limit} steps",
                where="max_steps",
                expected="episodes that end at the limit of their suite, where their results are written",
                remedy="leave out max_steps, or leave out both out and label",
            )
        self._save()
        return {"success": progress.success, "reason": progress.reason}

    def get_metadata(self) -> dict[str, Any]:
        """Return the metadata; ``max_steps`` is the largest limit, but each episode ends at its own suite's limit."""
        settings = self._environment.settings
        # A list of tasks names no suites. Own suites have a limit only if the settings state it.
        named = self._selection.suites or (SUITES if settings.own_step_limit is None else suites())
        return {
            "max_steps": max(map(settings.step_limit, named)),
            "max_episodes_per_task": 1,
            "selection": self._selection.model_dump(mode="json"),
            "settings": settings.model_dump(mode="json"),
        }

    def get_action_spec(self) -> dict[str, DimSpec]:
        """Return the format of actions."""
        absolute = self._environment.settings.actions == "absolute"
        return {**ACTION, "position": POSITION_ABSOLUTE} if absolute else ACTION

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """Return the format of observations."""
        spec = {"agentview": IMAGE_RGB, "language": LANGUAGE}
        if self._wanted.wrist:
            spec["wrist"] = IMAGE_RGB
        if self._wanted.state:
            spec["state"] = STATE_EEF_POS_AA_GRIP
        return spec

    def cleanup(self) -> None:
        """Close the environment."""
        self._environment.close()

    def _look(self) -> dict[str, Any]:
        """Render an observation and keep it, because it may be sent again."""
        self._last = self._environment.observation(self._wanted)
        return self._last

    def _save(self) -> None:
        """Store the episode's row if rows are wanted."""
        if self._evaluation is not None:
            self._evaluation.save(self._environment, self._wanted)


class ReplayServer(ModelServer):  # type: ignore[misc]
    """Model server that answers with the actions of a demonstration of the task.

    Args:
        chunk: number of actions in each answer; all are taken before the next observation. Without effect if tracked.
        tracked: follow the demonstration's path by the state in each observation, one action at a time.
        demos: folder of the demonstrations; by default the starter set.
    """

    def __init__(self, *, chunk: int = 1, tracked: bool = False, demos: str | None = None):
        self._chunk, self._tracked = chunk, tracked
        self._demos = None if demos is None else Path(demos)
        self._replays: dict[str, Replay | TrackedReplay] = {}

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        """Begin a replay of the episode's demonstration."""
        replay: Replay | TrackedReplay = Replay(self._chunk, self._demos)
        if self._tracked:
            replay = TrackedReplay(self._demos)
        self._replays[ctx.session_id] = replay
        replay.begin(EvaluationTask.of_harness(config["task"]))

    async def on_observation(self, obs: dict[str, Any], ctx: SessionContext) -> None:
        """Answer with the next actions."""
        actions = self._replays[ctx.session_id].act(lambda _: obs)
        # A chunk of one action is sent as a single action (7,). A longer chunk is sent as a chunk even if only one
        # action is left, because this server keeps no actions.
        await ctx.send_action({"actions": actions.squeeze() if self._tracked or self._chunk == 1 else actions})

    def get_observation_params(self) -> dict[str, Any]:
        """Return the content of the observations that this server needs."""
        return {"send_state": self._tracked}

    def get_action_spec(self) -> dict[str, DimSpec]:
        """Return the format of actions."""
        return ACTION

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """Return the format of observations."""
        return {"image": IMAGE_RGB, **({"state": STATE_EEF_POS_AA_GRIP} if self._tracked else {})}


if __name__ == "__main__":
    ensure_fixed_machine_code()
    run_server(ReplayServer)
