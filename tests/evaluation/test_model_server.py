"""docs/model-server.md is true: its server runs, receives what the tables state, and is warned if it does not ask."""

import json
import logging
import re
import runpy
import shlex
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from anyio.from_thread import start_blocking_portal
from checkout import REPOSITORY
from server_process import running
from short_demonstrations import STOVE
from vla_eval.model_servers.base import ModelServer
from vla_eval.model_servers.serve import serve_async

from pipeline.__main__ import main
from pipeline.compute.pool import loop
from pipeline.errors import PipelineError
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.evaluation import Evaluation
from pipeline.evaluation.harness import PerturbedLibero, ReplayServer
from pipeline.evaluation.model_server import Server, warn_of_requests
from pipeline.evaluation.policies import StateAngle
from pipeline.evaluation.policy_config import PolicyConfig
from pipeline.evaluation.results import EpisodeFiles
from pipeline.evaluation.selection import Selection
from pipeline.evaluation.tasks import libero_task
from pipeline.libero.tasks import STEP_LIMITS

EXAMPLE = REPOSITORY / "examples" / "model_server.py"
PAGE = (REPOSITORY / "docs" / "model-server.md").read_text()
CLOSED_EYES: type[Any] = runpy.run_path(str(EXAMPLE))["ClosedEyes"]


class Serve:
    """Servers in threads of this process; a call starts a server and returns its address."""

    def __init__(self, portal: Any):
        self._portal = portal

    def __call__(self, server: ModelServer) -> str:
        _, port = self._portal.start_task(serve_async, server, "127.0.0.1", 0)
        return f"ws://127.0.0.1:{port}"


@pytest.fixture
def serve() -> Iterator[Serve]:
    with start_blocking_portal() as portal:
        yield Serve(portal)
        portal.call(portal.stop, True)


class Recorder(CLOSED_EYES):  # type: ignore[misc]
    """The server of the page, which also keeps what it receives."""

    def __init__(self, **place_m: float):
        super().__init__(**place_m)
        self.observations: list[dict[str, Any]] = []
        self.messages: list[dict[str, Any]] = []

    def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
        self.observations.append(obs)
        answer: dict[str, Any] = super().predict(obs, ctx)
        return answer

    async def on_episode_start(self, config: dict[str, Any], ctx: Any) -> None:
        self.messages.append(config)
        await super().on_episode_start(config, ctx)

    async def on_episode_end(self, result: dict[str, Any], ctx: Any) -> None:
        self.messages.append(result)
        await super().on_episode_end(result, ctx)


class Asking(ReplayServer):
    """A server with other observation parameters."""

    def __init__(self, **params: bool):
        super().__init__(chunk=8)
        self._params = params

    def get_observation_params(self) -> dict[str, Any]:
        return self._params


def rows_of(heading: str) -> dict[str, list[str]]:
    """The cells of the table under a heading of the page, by their first cell without marks of code."""
    section = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    return {cells[0].strip("`"): cells[1:] for cells in rows[2:]}


def test_the_page_shows_the_example() -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert block in EXAMPLE.read_text()
    assert block.startswith("class ClosedEyes")
    assert "run_server(ClosedEyes)\n" in block


@pytest.mark.slow
def test_the_server_receives_what_the_table_states_and_moves_the_hand_there(serve: Serve) -> None:
    server = Recorder(x_m=0.05, y_m=-0.1, z_m=1.15)
    task = libero_task(STOVE, 0)
    with closing(EpisodeEnvironment(EpisodeSettings())) as environment, closing(Server(serve(server))) as policy:
        environment.reset(task)
        policy.begin(task)
        while len(server.observations) < 15:
            for action in policy.act(environment.observation):
                environment.step(action)
        policy.end(False)
    *_, last = server.observations
    table = rows_of("Observations")
    parts = {
        'obs["images"]["agentview"]': last["images"]["agentview"],
        'obs["images"]["wrist"]': last["images"]["wrist"],
        'obs["states"]': last["states"],
        'obs["controller_states"]': last["controller_states"],
    }
    for name, part in parts.items():
        assert table[name][0] == f"{part.shape} {part.dtype}", name
    assert last["task_description"] == "turn on the stove"
    assert {*table} == {*parts, 'obs["task_description"]'}
    assert {*last} == {"images", "states", "controller_states", "task_description"}
    np.testing.assert_allclose(last["states"][:3], [0.05, -0.1, 1.15], atol=0.01)
    start, end = server.messages
    assert start["task"] == task.for_harness()
    assert end == {"metrics": {"success": False}}


@pytest.mark.slow
def test_the_commands_of_the_page_evaluate_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As they stand, but with the free port of the test, another folder and shorter episodes."""
    (command,) = re.findall(r"^python -m (pipeline evaluate .*)$", PAGE.replace("\\\n", " "), re.MULTILINE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(STEP_LIMITS, STOVE.suite, 45)
    with running(str(EXAMPLE)) as address:
        monkeypatch.setattr(sys, "argv", shlex.split(command.replace("ws://127.0.0.1:8000", address)))
        assert main() in (None, 0)
    told = capsys.readouterr()
    assert "announces neither" not in told.err
    assert json.loads(told.out.splitlines()[-1])["all"]["episodes"] == 1
    (row,) = EpisodeFiles(tmp_path / "results" / "closed_eyes").rows()
    assert (row.base, row.reason, row.steps, row.looks) == ("turn_on_the_stove", "step_limit", 45, 5)
    assert (row.settings["wrist"], row.settings["state"], row.settings["shortest_rotation"]) == (True, True, False)


@pytest.mark.parametrize(
    ("params", "warned"),
    [
        ({}, True),
        ({"quat_no_antipodal": True}, True),
        ({"send_state": False}, False),
        ({"send_wrist_image": True}, False),
    ],
)
def test_a_server_that_does_not_ask_is_warned_of(
    params: dict[str, bool], warned: bool, serve: Serve, caplog: pytest.LogCaptureFixture
) -> None:
    address = serve(Asking(**params))
    warn_of_requests(address, timeout_s=10, actions="delta", state_angle="server")
    told = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(told) == warned
    for message in told:
        assert message.startswith(f"{address} announces neither send_wrist_image nor send_state")
        assert "only the agent view" in message


@pytest.mark.parametrize(
    ("params", "state_angle", "shortest", "warned"),
    [
        ({"send_state": True}, "server", True, True),
        ({"send_state": True}, "pi", True, False),
        ({"send_state": True}, "2pi", False, False),
        ({"send_state": True, "quat_no_antipodal": True}, "server", False, False),
        ({"send_state": True, "quat_no_antipodal": True}, "pi", True, False),
        ({"send_state": False, "send_wrist_image": True}, "server", True, False),
    ],
)
def test_the_user_chooses_the_range_of_angles_for_a_server_that_cannot(
    params: dict[str, bool],
    state_angle: StateAngle,
    shortest: bool,
    warned: bool,
    serve: Serve,
    caplog: pytest.LogCaptureFixture,
) -> None:
    address = serve(Asking(**params))
    warn_of_requests(address, timeout_s=10, actions="delta", state_angle=state_angle)
    assert ["--state-angle 2pi" in record.getMessage() for record in caplog.records] == [True] * warned
    with closing(Server(address, state_angle=state_angle)) as server:
        assert server.wanted.shortest_rotation == shortest


def test_the_servers_of_vla_eval_ask_for_the_angles_that_the_warning_names() -> None:
    """Those of lerobot and pi0 have no parameter for it; that of OpenVLA-OFT asks for [0, 2 pi]."""
    from vla_eval.model_servers.lerobot import LeRobotModelServer
    from vla_eval.model_servers.oft import OFTModelServer
    from vla_eval.model_servers.pi0 import Pi0ModelServer

    attributes = {
        "state_key": "state", "wrist_image_key": "wrist", "_expected_image_keys": ["a", "b"], "_image_keys_arg": None,
        "num_images_in_input": 2, "use_proprio": True,
    }  # fmt: skip
    requests = {}
    for kind in (LeRobotModelServer, OFTModelServer, Pi0ModelServer):
        server = kind.__new__(kind)
        vars(server).update(attributes)
        requests[kind] = server.get_observation_params()
        assert requests[kind]["send_state"]
    assert [bool(params.get("quat_no_antipodal")) for params in requests.values()] == [False, True, False]


def test_angles_for_a_server_without_the_state_are_rejected(serve: Serve) -> None:
    address = serve(Asking(send_wrist_image=True))
    with pytest.raises(PipelineError, match="does not request the state"):
        warn_of_requests(address, timeout_s=10, actions="delta", state_angle="2pi")


@pytest.mark.parametrize(("state_angle", "shortest"), [("server", True), ("pi", True), ("2pi", False)])
def test_the_harness_gives_the_angles_that_its_settings_state(state_angle: StateAngle, shortest: bool) -> None:
    benchmark = PerturbedLibero(settings={"state_angle": state_angle}, send_state=True)
    assert benchmark._wanted.shortest_rotation == shortest


@pytest.mark.slow
def test_an_evaluation_warns_once(
    serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(STEP_LIMITS, STOVE.suite, 10)
    policy = PolicyConfig(kind="server", address=serve(Asking()), label="silent")
    evaluation = Evaluation(EpisodeSettings(), policy, policy.identity(), tmp_path)
    chosen = Selection(suites=(STOVE.suite,), tasks=(STOVE.name,), episodes=2)
    assert evaluate(evaluation, chosen, loop)["all"]["episodes"] == 2
    assert sum("announces neither" in record.getMessage() for record in caplog.records) == 1
