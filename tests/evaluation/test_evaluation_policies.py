"""A policy that fails costs the episode that it fails in."""

import asyncio
import json
import queue
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import checkpoints
import numpy as np
import pytest
import websockets
from anyio.from_thread import start_blocking_portal
from checkout import REPOSITORY
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from server_process import running
from short_demonstrations import STOVE
from vla_eval.model_servers.base import ModelServer
from vla_eval.model_servers.groot import GR00TModelServer
from vla_eval.model_servers.serve import serve_async
from vla_eval.model_servers.xvla import _PROFILE_OBS_PARAMS as XVLA
from vla_eval.protocol.messages import Message, MessageType, make_hello_payload, pack_message, unpack_message
from websockets.asyncio.server import ServerConnection

from pipeline.__main__ import main
from pipeline.compute.pool import loop
from pipeline.errors import PipelineError
from pipeline.evaluation.actions import PolicyError, checked_actions
from pipeline.evaluation.checkpoint import Checkpoint, cameras_of
from pipeline.evaluation.environment import EpisodeSettings
from pipeline.evaluation.evaluate import _open_environment, evaluate
from pipeline.evaluation.evaluation import Evaluation
from pipeline.evaluation.model_server import Server
from pipeline.evaluation.policies import Wanted
from pipeline.evaluation.policy_config import PolicyConfig
from pipeline.evaluation.results import EpisodeFiles
from pipeline.evaluation.selection import Selection
from pipeline.evaluation.tasks import libero_task

FAULTY_AND_STOVE = Selection(
    suites=("libero_object", "libero_goal"), tasks=("pick_up_the_milk*", "push_the_plate*", "turn_on*")
)
FAULTY_SERVER = str(REPOSITORY / "tests" / "faulty_server.py")
RECORDED = EpisodeSettings(initial_states="demonstration")


def test_answers_are_checked_before_any_is_taken() -> None:
    assert checked_actions([0.0] * 7, "policy").shape == (1, 7)
    assert checked_actions(np.zeros((8, 7), np.float32), "policy").shape == (8, 7)
    for answer in (None, "left", [[0.0] * 7, [0.0] * 6], np.zeros((2, 6)), np.zeros((0, 7)), [np.inf] * 7):
        with pytest.raises(PolicyError, match="policy"):
            checked_actions(answer, "policy")


def test_a_server_of_other_actions_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """vla-eval's own server without its weights, with X-VLA's parameters for LIBERO, and with those of LIBERO."""
    monkeypatch.setattr(GR00TModelServer, "_init_policy", lambda self: None)
    with start_blocking_portal() as portal:

        def address(server: ModelServer) -> str:
            _, port = portal.start_task(serve_async, server, "127.0.0.1", 0)
            return f"ws://127.0.0.1:{port}"

        with pytest.raises(PipelineError, match=r"announces gripper continuous_01(?s:.*)args\.invert_gripper"):
            Server(address(GR00TModelServer()))
        xvla = address(GR00TModelServer(invert_gripper=True, observation_params=XVLA["libero"]))
        with pytest.raises(PipelineError, match=r"announces absolute actions(?s:.*)--actions absolute"):
            Server(xvla)
        Server(xvla, actions="absolute").close()
        deltas = address(GR00TModelServer(invert_gripper=True))
        with pytest.raises(PipelineError, match=r"announces delta actions(?s:.*)--actions delta"):
            Server(deltas, actions="absolute")
        asked = {"send_wrist_image": True, "quat_no_antipodal": True}
        for params, wanted in ((None, Wanted(wrist=False, shortest_rotation=True)), (asked, Wanted())):
            with closing(Server(address(GR00TModelServer(invert_gripper=True, observation_params=params)))) as taken:
                assert taken.wanted == wanted
        portal.call(portal.stop, True)


@pytest.fixture(scope="module", autouse=True)
def memory_given_back() -> Iterator[None]:
    """A process keeps its environment for the next evaluation."""
    yield
    _open_environment(RECORDED, None).close()
    _open_environment.cache_clear()


def images(**keys: int) -> dict[str, PolicyFeature]:
    """Return image features: name after ``observation.images.`` to height and width."""
    features = {}
    for name, size_px in keys.items():
        features[f"observation.images.{name}"] = PolicyFeature(FeatureType.VISUAL, (3, size_px, size_px))
    return features


OURS = {"observation.images.image": "agentview", "observation.images.image2": "wrist"}


def test_checkpoints_that_pad_missing_images_get_the_two_views(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """lerobot's own configurations: pi0.5 as its command for LIBERO sets it, and SmolVLA with its weights' cameras."""
    pi05 = PI05Config(input_features=images(image=256, image2=224), empty_cameras=1, device="cpu")
    pi05.validate_features()
    assert "observation.images.empty_camera_0" in pi05.image_features
    cameras = cameras_of(pi05, {}, tmp_path)
    assert {key: camera.view for key, camera in cameras.items()} == OURS
    assert [camera.size_px for camera in cameras.values()] == [(256, 256), (224, 224)]
    smolvla = SmolVLAConfig(input_features=images(camera1=256, camera2=256, camera3=256), device="cpu")
    renamed = {key: f"observation.images.camera{number}" for number, key in enumerate(OURS, 1)}
    assert {key: camera.view for key, camera in cameras_of(smolvla, renamed, tmp_path).items()} == OURS
    assert [record.getMessage().count("camera3, so") for record in caplog.records] == [1]
    for lost in ({}, {"observation.images.image": "observation.images.camera1"}):
        with pytest.raises(PipelineError, match=r"needs the images .*camera3, which"):
            cameras_of(smolvla, lost, tmp_path)


def test_a_checkpoint_that_needs_another_image_is_rejected(tmp_path: Path) -> None:
    act = ACTConfig(input_features=images(image=32, front=32), device="cpu")
    with pytest.raises(PipelineError, match=r"needs the images .*front, which") as found:
        cameras_of(act, {}, tmp_path)
    assert "--rename_map" in str(found.value)


def test_a_checkpoint_whose_weights_lerobot_did_not_load_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """lerobot 0.6.1's pi0.5 keeps random weights after a failure, as this stand-in does."""
    folder = checkpoints.save(tmp_path, 0.25)
    Checkpoint(folder)
    (folder / "model.safetensors").rename(folder / "kept")
    with pytest.raises(PipelineError, match="no weights of its own"):
        Checkpoint(folder)
    (folder / "kept").rename(folder / "model.safetensors")
    monkeypatch.setattr(ACTPolicy, "from_pretrained", classmethod(lambda kind, _, config: kind(config)))
    with pytest.raises(PipelineError, match=r"model\.safetensors: lerobot did not load the weights \(model\."):
        Checkpoint(folder)


@pytest.mark.slow
def test_a_checkpoint_that_names_code_of_other_packages_is_rejected_before_it_runs(tmp_path: Path) -> None:
    """lerobot imports and calls what a checkpoint names, its own functions that run a file too."""
    folder, ran, code = checkpoints.save(tmp_path, 0.25), tmp_path / "ran", tmp_path / "code.py"
    code.write_text(f"open({str(ran)!r}, 'w').close()")
    foreign: list[Any] = [
        {"class": "subprocess.Popen", "config": {"args": ["touch", str(ran)]}},
        {"class": "lerobot.envs.utils._load_module_from_path", "config": {"path": str(code)}},
        {"class": 3},
        "no step",
    ]
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        text = (folder / name).read_text()
        for step in foreign:
            saved = json.loads(text)
            saved["steps"].append(step)
            (folder / name).write_text(json.dumps(saved))
            with pytest.raises(PipelineError, match=rf"{name}: .* is not a step of lerobot"):
                Checkpoint(folder)
        assert not ran.exists()
        (folder / name).write_text(text)


def test_a_checkpoint_may_name_a_class_of_lerobot(tmp_path: Path) -> None:
    """As lerobot does for its steps without a registered name."""
    folder = checkpoints.save(tmp_path, 0.25)
    file = folder / "policy_preprocessor.json"
    saved = json.loads(file.read_text())
    own = {"class": "lerobot.processor.rename_processor.RenameObservationsProcessorStep", "config": {}}
    file.write_text(json.dumps({**saved, "steps": [*saved["steps"], own]}))
    Checkpoint(folder)


@pytest.mark.parametrize("config", [SmolVLAConfig, PI05Config])
def test_a_checkpoint_whose_packages_are_missing_is_named_with_the_server_that_has_them(
    config: type[SmolVLAConfig | PI05Config], tmp_path: Path
) -> None:
    """The project installs lerobot without transformers, which both policies need."""
    assert find_spec("transformers") is None, "the tests are of the locked packages"
    kind = config(input_features=images(image=32, image2=32), device="cpu")
    kind.save_pretrained(tmp_path)
    (tmp_path / "model.safetensors").touch()
    with pytest.raises(PipelineError, match=f"cannot load a policy of the type {kind.type}") as found:
        Checkpoint(tmp_path)
    assert f"vla_eval.model_servers.lerobot --args.policy_type {kind.type} --args.checkpoint" in str(found.value)


def test_a_checkpoint_of_a_policy_that_lerobot_does_not_have_is_named(tmp_path: Path) -> None:
    """Such as MolmoAct2 of lerobot 0.6.1 under 0.4.4."""
    (tmp_path / "config.json").write_text('{"type": "policy_of_tomorrow"}')
    with pytest.raises(PipelineError, match=r"policy_of_tomorrow: lerobot [\d.]+ has no policy of this type"):
        Checkpoint(tmp_path)


@pytest.mark.parametrize(("least", "warnings"), [(-1.0, 0), (0.0, 1)])
def test_a_checkpoint_whose_gripper_would_be_inverted_is_named(
    least: float, warnings: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Commands from 0 (closed) to 1 (open) are IPEC's, and ACT returns them as they are."""
    Checkpoint(checkpoints.save(tmp_path, 0.25, least=least))
    assert [record.getMessage().count("gripper commands from 0 to 1") for record in caplog.records] == [1] * warnings


def test_a_checkpoint_of_renamed_images_acts_like_one_of_ours(tmp_path: Path) -> None:
    """It gets the agent view under its own name."""
    agent_view = np.resize(np.arange(251, dtype=np.uint8), (32, 32, 3))
    shown = {
        "images": {"agentview": agent_view, "wrist": np.zeros((256, 256, 3), np.uint8)},
        "states": np.zeros(8, np.float32),
        "task_description": "",
    }
    for image in (checkpoints.IMAGE, "observation.images.camera1"):
        policy = Checkpoint(checkpoints.save(tmp_path / image, 0.25, image=image))
        seen: dict[str, Any] = {}
        processed = policy._before
        policy._before = lambda batch, process=processed, seen=seen: seen.setdefault("batch", process(batch))
        policy.begin(libero_task(STOVE, 0))
        assert policy.act(lambda _: shown) == pytest.approx(np.full((checkpoints.CHUNK, 7), 0.25), abs=1e-6)
        network_input = seen["batch"][image][0].numpy()
        assert network_input == pytest.approx(agent_view.transpose(2, 0, 1) / 255, abs=1e-6)


@pytest.mark.slow
def test_other_episodes_are_run_when_some_get_no_action(tmp_path: Path) -> None:
    with running(FAULTY_SERVER) as address:
        policy = PolicyConfig(kind="server", address=address, label="faulty", timeout_s=10)
        with pytest.raises(PipelineError, match="2 episodes without a result") as raised:
            evaluate(Evaluation(RECORDED, policy, policy.identity(), tmp_path), FAULTY_AND_STOVE, loop)
        assert json.loads((tmp_path / "summary.json").read_text())["all"]["episodes"] == 1
        table = (tmp_path / "episodes.csv").read_text()
        plate_alone = Selection(suites=("libero_goal",), tasks=("push_the_plate*",))
        with pytest.raises(PipelineError, match="1 episode without a result"):
            evaluate(Evaluation(RECORDED, policy, policy.identity(), tmp_path), plate_alone, loop)
    assert (tmp_path / "episodes.csv").read_text() == table, "the earlier result stays"
    assert "turn_on_the_stove" in table
    for told in ("within 10 s", "pick_up_the_milk", "no such camera", "push_the_plate"):
        assert told in str(raised.value)
    (row,) = EpisodeFiles(tmp_path).rows()
    assert row.base == "turn_on_the_stove"
    assert row.success


@pytest.mark.slow
def test_a_server_that_dies_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    suites = ["--suite", "libero_object", "--suite", "libero_goal", "--task", "pick_up_the_milk*", "--task", "turn_on*"]
    options = ["--initial-states", "demonstration", "--workers", "1"]
    with running(FAULTY_SERVER, "--args.dies", "true") as address:
        command = ["pipeline", "evaluate", str(tmp_path), *suites, *options, "--server", address, "--label", "faulty"]
        monkeypatch.setattr(sys, "argv", command)
        assert main() == 1
    told = capsys.readouterr().err
    assert "Traceback" not in told
    assert "run the same command again" in told
    assert not any(row.base.startswith("pick_up_the_milk") for row in EpisodeFiles(tmp_path).rows())


@pytest.mark.parametrize("aborted", [False, True], ids=["closed", "aborted"])
def test_an_episode_whose_server_was_restarted_has_no_result(aborted: bool) -> None:
    """The server closes its first connection after one answer, while the simulator works, and accepts a new one."""
    connections: list[list[MessageType]] = []

    async def serve_episode(socket: ServerConnection) -> None:
        received: list[MessageType] = []
        connections.append(received)
        is_first = len(connections) == 1
        async for raw in socket:
            message = unpack_message(raw)
            received.append(message.type)
            if message.type == MessageType.HELLO:
                payload = make_hello_payload(model_server="restarted", capabilities={})
                await socket.send(pack_message(Message(type=message.type, payload=payload, seq=message.seq)))
            elif message.type == MessageType.OBSERVATION:
                payload = {"actions": np.zeros(7, np.float32)}
                await socket.send(pack_message(Message(type=MessageType.ACTION, payload=payload, seq=message.seq)))
                if is_first:
                    await asyncio.sleep(0.1)
                    if aborted:
                        socket.transport.abort()
                    return

    ports: queue.SimpleQueue[int] = queue.SimpleQueue()

    async def serve() -> None:
        async with websockets.serve(serve_episode, "127.0.0.1", 0, ping_interval=None) as server:
            ports.put(server.sockets[0].getsockname()[1])
            await asyncio.Future()

    threading.Thread(target=lambda: asyncio.run(serve()), daemon=True).start()
    policy = Server(f"ws://127.0.0.1:{ports.get()}", timeout_s=5)
    task = libero_task(STOVE, 0)

    def look(wanted: Wanted) -> dict[str, Any]:
        return {"images": {}, "task_description": ""}

    policy.begin(task)
    policy.act(look)
    time.sleep(0.3)
    with pytest.raises(PolicyError, match=r"the connection was (lost in the episode|closed)"):
        policy.act(look)
    policy.begin(task)
    policy.act(look)
    policy.close()
    last = connections[-1]
    assert last[last.index(MessageType.EPISODE_START) :][:2] == [MessageType.EPISODE_START, MessageType.OBSERVATION]
