"""A demonstration goes through each client's normalisation and back, and its task succeeds in an evaluation.

lerobot's dataset and processors are its own. OpenVLA-OFT's and openpi's formulas are written out here, from
``modeling_prismatic.py``, ``robot_utils.py`` (213c5ff) and ``transforms.py`` (15a9616): neither is in this environment.
``benchmarks/clients/round.py`` runs openpi's own code.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.factory import make_pre_post_processors
from short_demonstrations import BOWL, SHORT, starter_demo
from short_runs import datasets_in
from synthetic import IDS, NAME, SET, episode, loop

from pipeline.clients import oft, recipe
from pipeline.clients.files import OPENPI_ASSETS
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.policies import Look, Wanted
from pipeline.evaluation.rollout import roll_out_policy
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.export_config import ExportConfig
from pipeline.formats import exact_statistics
from pipeline.formats.episodes import EpisodeFacts, Episodes
from pipeline.formats.lerobot import LeRobot, LeRobotConfig, LeRobotV21, LeRobotV21Config
from pipeline.formats.rlds import Rlds, RldsConfig
from pipeline.libero.starts import kept_actions
from pipeline.run.export import export
from pipeline.types import Episode, Floats

pytestmark = pytest.mark.slow

DEMOS = dict(zip(IDS, SHORT, strict=False))
"""Three demonstrations, so that the statistics are not those of the one that is evaluated."""

EVALUATED = next(one for one, task in DEMOS.items() if task == BOWL)
CHUNK = 8

Round = tuple[Floats, Floats]
"""All normalised actions of the set, (N, 7); and those of ``EVALUATED`` as the client would act, (T, 7)."""


def demonstration(episode_id: str) -> Episode:
    """The actions of a demonstration, with states and frames of nothing."""
    recorded = starter_demo(DEMOS[episode_id]).actions
    action = recorded[kept_actions(recorded, "drop")].astype(np.float32)
    steps, small = len(action), episode(episode_id)
    return replace(
        small,
        action=action,
        action_absolute=action,
        state=np.resize(small.state, (steps, 8)),
        joint_state=np.resize(small.joint_state, (steps, 7)),
        frames={view: [frames[0]] * steps for view, frames in small.frames.items()},
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with the demonstrations in every format, and what clients normalise by."""
    data = tmp_path_factory.mktemp("round")
    made = {one: demonstration(one) for one in DEMOS}
    known = {
        one: EpisodeFacts("libero_spatial", "content", "", each.instruction, len(each)) for one, each in made.items()
    }
    v21 = LeRobotV21Config(name=NAME, convention="openpi")
    rlds, lerobot = RldsConfig(name=NAME, shards=1), LeRobotConfig(name=NAME, shards=1)
    for target in (Rlds(data, rlds), LeRobot(data, lerobot), LeRobotV21(data, v21)):
        export(target, Episodes(known, made.__getitem__), loop)
    statistics = exact_statistics.openvla([(one.action, one.state) for one in made.values()])
    (data / "dataset_statistics.json").write_text(json.dumps({SET: statistics}))
    options = ExportConfig.model_validate({"rlds": rlds, "lerobot": lerobot, "lerobot_v21": v21})
    recipe.write({}, data / "finetune", options, datasets_in(data))
    return data


def by_oft(data: Path) -> Round:
    """Every eighth chunk of 8, as OFT is asked; the gripper to 0 and 1 and back, as its LIBERO evaluation does it."""
    statistics = json.loads((data / "dataset_statistics.json").read_text())[SET]
    samples = {one.name: oft.trajectory(one, statistics) for one in oft.read(data / "rlds" / SET / "1.0.0")}
    chunks = {name: found.actions for name, found in samples.items() if found is not None}
    first = chunks[EVALUATED]
    # The last chunk that OFT learns of ends with the episode.
    normalised = np.concatenate([*first[: len(first) - 1 : CHUNK], first[-1][-((len(first) - 1) % CHUNK or CHUNK) :]])
    figures = {name: np.array(value) for name, value in statistics["action"].items()}
    low, high = figures["q01"], figures["q99"]
    actions = np.where(figures["mask"], 0.5 * (normalised + 1) * (high - low + 1e-8) + low, normalised)
    actions[:, -1] = -np.sign(2 * actions[:, -1] - 1)
    every = np.concatenate([np.concatenate([each[:, 0], each[-1, 1:]]) for each in chunks.values()])
    return every, actions


def by_openpi(data: Path) -> Round:
    """Quantile normalisation, without a bound; LIBERO's gripper is neither turned nor left out."""
    figures = json.loads((data / "finetune" / OPENPI_ASSETS).read_text())["norm_stats"]["actions"]
    low, high = np.array(figures["q01"]), np.array(figures["q99"])
    rows = pq.read_table(data / "lerobot_v21" / NAME / "data", columns=["episode_id", "actions"]).to_pylist()
    actions = np.array([row["actions"] for row in rows])
    normalised = (actions - low) / (high - low + 1e-6) * 2 - 1
    mine = np.array([row["episode_id"] == EVALUATED for row in rows])
    return normalised, (normalised[mine] + 1) / 2 * (high - low + 1e-6) + low


def by_lerobot(data: Path) -> Round:
    """lerobot's dataset with chunks, and the processors of ACT before and after the policy."""
    root = data / "lerobot" / NAME
    chunk = {"action": [step / 20 for step in range(CHUNK)]}
    dataset = LeRobotDataset(NAME, root=root, delta_timestamps=chunk, video_backend="pyav")
    config = ACTConfig(
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (8,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        device="cpu",
        push_to_hub=False,
    )
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    ids = list(dataset.hf_dataset.with_format(None)["episode_id"])
    column = np.stack(dataset.hf_dataset.with_format("numpy")["action"])
    state = torch.zeros(1, 8)  # the processors insist on an observation
    normalised = before({"action": torch.from_numpy(column), "observation.state": state})["action"].numpy()
    actions = []
    for step in range(ids.index(EVALUATED), ids.index(EVALUATED) + ids.count(EVALUATED), CHUNK):
        item = dataset[step]
        taken = before({"action": item["action"][None], "observation.state": state})["action"][0]
        actions.append(after(taken).numpy()[~item["action_is_pad"].numpy()])
    return normalised, np.concatenate(actions)


def bounds(normalised: Floats) -> None:
    np.testing.assert_allclose(np.quantile(normalised[:, :6], (0.01, 0.99), axis=0), [[-1] * 6, [1] * 6], atol=0.01)


def unit(normalised: Floats) -> None:
    np.testing.assert_allclose(normalised.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(normalised.std(axis=0), 1, atol=1e-4)


class Chunks:
    """Acts as told, a chunk at a time, and then waits."""

    name = "round"
    wanted = Wanted(wrist=False, state=False, images=False)

    def __init__(self, actions: Floats):
        self._chunks: Iterator[Any] = iter(np.split(actions, range(CHUNK, len(actions), CHUNK)))
        self._rest = np.tile([0.0] * 6 + [-1.0], (CHUNK, 1))

    def begin(self, task: EvaluationTask) -> None: ...

    def act(self, look: Look) -> Any:
        return next(self._chunks, self._rest)

    def end(self, success: bool) -> None: ...


@pytest.fixture(scope="module")
def environment() -> Iterator[EpisodeEnvironment]:
    with closing(EpisodeEnvironment(EpisodeSettings(initial_states="demonstration"))) as environment:
        yield environment


@pytest.mark.parametrize(("client", "promised"), [(by_oft, bounds), (by_openpi, bounds), (by_lerobot, unit)])
def test_a_demonstration_succeeds_after_a_round_through_the_client(
    data: Path, environment: EpisodeEnvironment, client: Callable[[Path], Round], promised: Callable[[Floats], None]
) -> None:
    normalised, actions = client(data)
    promised(normalised)
    assert len(actions) == len(demonstration(EVALUATED))
    (task,) = select(Selection(suites=(BOWL.suite,), tasks=(BOWL.name,)))
    roll_out_policy(environment, Chunks(actions), task)
    assert environment.progress.success
    actions[:, 6] *= -1
    roll_out_policy(environment, Chunks(actions), task)
    assert not environment.progress.success
