"""lerobot's language columns: as lerobot 0.6.1 defines them, and where that is installed, as it reads them."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from packaging.version import Version
from synthetic import IDS, NAME, REWRITES, SUBTASKS, episode, episodes, loop, write_lerobot

from pipeline.config import load
from pipeline.episode_schema import STANDARD
from pipeline.errors import PipelineError
from pipeline.formats.lerobot import LeRobot, LeRobotConfig, read
from pipeline.formats.lerobot.columns import CONVENTIONS, Layout
from pipeline.run.export import export
from pipeline.types import Episode, Geometry
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS

LEROBOT = Version(version("lerobot"))

TEXTS = pa.list_(pa.string())


CAMERA = "observation.images.image"


def told(episode_id: str) -> Episode:
    """Return an episode whose hand goes from the middle of the picture to the right, 1 m in front of the camera."""
    made = episode(episode_id)
    state = made.state.copy()
    state[:, :3] = [0.0, 0.0, 1.0]
    state[:, 0] += 0.01 * np.arange(len(made))
    intrinsics = np.array([[100, 0, 128], [0, 100, 128], [0, 0, 1]], np.float32)
    seen = Geometry(intrinsics, np.eye(4, dtype=np.float32))
    geometry = {"image": seen, "wrist_image": seen}
    return replace(made, state=state, geometry=geometry, rewrites=REWRITES, subtasks=SUBTASKS)


def trace(step: int, steps: int) -> str:
    """Return the trace of ``told`` that begins at a step of an episode."""
    points = [[128 + step + later, 128] for later in range(0, steps - step, 4)]
    return json.dumps({"label": "gripper", "point_format": "xy", "points": points})


def write_told(folder: Path, convention: str) -> Path:
    """Write a set whose last two episodes are of the split ``val``."""
    # Rejected when it is read where lerobot is older; the writer asks nothing of lerobot.
    update = {"language": True, "convention": convention}
    dataset = LeRobot(folder, LeRobotConfig(name=NAME, shards=3, validation=0.3).model_copy(update=update))
    source = episodes(told)
    # Three demonstrations of a task, of two episodes each.
    known = {
        one: of._replace(demo=f"libero_spatial/task/demo_{k // 2}") for k, (one, of) in enumerate(source.facts.items())
    }
    export(dataset, replace(source, facts=known), loop)
    return dataset.root


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_told(tmp_path_factory.mktemp("language"), "libero")


def rows(root: Path) -> list[dict[str, Any]]:
    return [row for file in sorted((root / "data").rglob("*.parquet")) for row in pq.read_table(file).to_pylist()]


def test_the_column_is_lerobots(root: Path) -> None:
    """``language_feature_info``, ``language_persistent_column_feature`` and ``language_events_column_feature`` of
    ``lerobot/datasets/language.py`` in 0.6.1, as ``datasets`` writes that in Arrow."""
    info = json.loads((root / "meta" / "info.json").read_text())
    text = pa.string()
    note = [("role", text), ("content", text), ("style", text)]
    source = [("camera", text), ("tool_calls", pa.list_(pa.json_()))]
    columns = {
        "language_persistent": pa.struct([*note, ("timestamp", pa.float32()), *source]),
        "language_events": pa.struct([*note, *source]),
    }
    for name, row in columns.items():
        assert info["features"][name] == {"dtype": "language", "shape": [1], "names": None}
        for file in (root / "data").rglob("*.parquet"):
            schema = pq.read_schema(file)
            assert schema.field(name).type == pa.list_(row)
            stored = datasets.Features.from_arrow_schema(schema)[name]
            assert stored.feature["tool_calls"] == datasets.List(datasets.Json())
        assert name not in json.loads((root / "meta" / "stats.json").read_text())


def test_every_frame_has_the_rewrites_and_subtasks_of_its_episode(root: Path) -> None:
    train = int(json.loads((root / "meta" / "info.json").read_text())["splits"]["train"].split(":")[1])
    assert train == 4
    found = rows(root)
    assert len(found) == sum(len(episode(one)) for one in IDS)
    for row in found:
        source = episode(row["episode_id"])
        said = row["language_persistent"]
        assert {(each["camera"], each["tool_calls"]) for each in said} == {(None, None)}
        subtasks = [each for each in said if each["style"] == "subtask"]
        assert [(each["role"], each["content"]) for each in subtasks] == [("assistant", one.text) for one in SUBTASKS]
        times = [np.float32(one.step / 20) for one in SUBTASKS]
        assert [np.float32(each["timestamp"]) for each in subtasks] == times
        wordings = [each for each in said if each["style"] == "task_aug"]
        expected = (source.instruction, *REWRITES) if row["episode_index"] < train else ()
        assert [each["content"] for each in wordings] == list(expected)
        assert {(each["role"], each["timestamp"]) for each in wordings} <= {("user", 0.0)}
        motions = [(each["role"], each["content"], each["timestamp"]) for each in said if each["style"] == "motion"]
        # The hand of every tenth step turns again, and its fingers close at step 6. A text has ten steps or more.
        assert [round(at_s * 20) for _, _, at_s in motions] == [0, 10][: 1 + (len(source) >= 20)]
        assert {role for role, _, _ in motions} == {"assistant"}
        assert motions[0][1].startswith("move forward, ")
        assert motions[0][1].endswith(", close the gripper")
        assert len(said) == len(subtasks) + len(wordings) + len(motions)
        shown = [(each["role"], each["style"], each["camera"], each["content"]) for each in row["language_events"]]
        step = row["frame_index"]
        begins = step % 10 == 0 and step + 4 < len(source)
        assert shown == ([("assistant", "trace", CAMERA, trace(step, len(source)))] if begins else [])


Said = list[list[dict[str, Any]]]


def lose_an_entry(said: Said) -> None:
    said[5].pop()


def reword(said: Said) -> None:
    said[0][0]["content"] = "turn on the stove"


def be_late(said: Said) -> None:
    said[-1][-1]["timestamp"] += 0.05


def change_the_speaker(said: Said) -> None:
    said[3][0]["role"] = "assistant"


def name_a_camera(said: Said) -> None:
    said[4][0]["camera"] = CAMERA


def say_nothing(said: Said) -> None:
    said[7].clear()


def reword_what_is_held_out(said: Said) -> None:
    said[2].insert(0, {**said[2][0], "role": "user", "style": "task_aug", "content": REWRITES[0]})


def keep(said: Said) -> None: ...


def move_to_the_next_frame(events: Said) -> None:
    events[1].append(events[0].pop())


def show_another_view(events: Said) -> None:
    events[0][0]["camera"] = "observation.images.image2"


def shift_a_point(events: Said) -> None:
    events[10][0]["content"] = events[10][0]["content"].replace("[138, 128]", "[139, 128]")


PERSISTENT, EVENTS = "language_persistent", "language_events"


def test_the_texts_do_not_depend_on_the_sign_of_the_gripper(root: Path, tmp_path: Path) -> None:
    ipec, libero = rows(write_told(tmp_path, "ipec")), rows(root)
    assert {row["action"][6] for row in ipec} == {0.0, 1.0}
    for name in ("language_persistent", "language_events"):
        assert [row[name] for row in ipec] == [row[name] for row in libero]


@pytest.mark.parametrize(
    ("column", "episode_index", "plant", "at"),
    [
        (PERSISTENT, 0, keep, None),
        (PERSISTENT, 4, keep, None),
        (PERSISTENT, 0, lose_an_entry, 5),
        (PERSISTENT, 0, reword, 0),
        (PERSISTENT, 0, be_late, -1),
        (PERSISTENT, 0, change_the_speaker, 3),
        (PERSISTENT, 0, name_a_camera, 4),
        (PERSISTENT, 4, say_nothing, 7),
        (PERSISTENT, 4, reword_what_is_held_out, 2),
        (EVENTS, 0, move_to_the_next_frame, 0),
        (EVENTS, 0, show_another_view, 0),
        (EVENTS, 4, shift_a_point, 10),
    ],
)
def test_what_validate_does_not_expect_in_it_is_found(
    root: Path, tmp_path: Path, column: str, episode_index: int, plant: Callable[[Said], None], at: int | None
) -> None:
    shutil.copytree(root, tmp_path / NAME)
    file, first = next(
        (file, pc.index(table["episode_index"], episode_index).as_py())
        for file in (tmp_path / NAME / "data").rglob("*.parquet")
        if episode_index in (table := pq.read_table(file))["episode_index"].to_pylist()
    )
    made = told(table["episode_id"][first].as_py())
    said = table[column].to_pylist()
    plant(part := said[first : first + len(made)])
    place = table.schema.get_field_index(column)
    field = table.schema.field(place)
    # pyarrow makes no JSON from Python.
    entry = [one.with_type(TEXTS) if one.name == "tool_calls" else one for one in field.type.value_type]
    spoiled = pa.array([*said[:first], *part, *said[first + len(made) :]], pa.list_(pa.struct(entry)))
    pq.write_table(table.set_column(place, field, spoiled.cast(field.type)), file)
    copy = read.read(tmp_path / NAME, made.episode_id, Layout(STANDARD, CONVENTIONS["libero"], "video"))
    assert copy is not None
    no_replay: Any = None
    found = CHECKS["instruction"].find(Case({"instruction": made.instruction}, made, no_replay, [copy], None))
    name = "language events" if column == EVENTS else "language column"
    expected = [] if at is None else [f"{name} of step {at % len(made)}"]
    assert [fault.what.split(" has ")[0] for fault in found] == expected


def test_without_it_no_frame_has_the_column(tmp_path: Path) -> None:
    plain = write_lerobot(tmp_path / "plain")
    assert "language" not in LeRobotConfig().model_dump()
    (file, *_) = (plain.root / "data").rglob("*.parquet")
    assert [name for name in pq.read_schema(file).names if name.startswith("language")] == []


# lerobot has language columns from 0.6 on.
if Version("0.6") > LEROBOT:

    def test_a_lerobot_that_cannot_read_it_is_said_before_any_work(tmp_path: Path) -> None:
        file = tmp_path / "told.yaml"
        file.write_text("{name: told, plan: {episodes: {camera: 1}}, export: {lerobot: {language: true}}}")
        with pytest.raises(PipelineError, match=r"export\.lerobot\.language: .*lerobot 0\.4\.4.*Python 3\.12"):
            load(file)

else:

    def test_lerobot_finds_the_motion_and_the_trace(root: Path) -> None:
        from lerobot.datasets.language import column_for_style, language_events_column_feature, validate_camera_field
        from lerobot.datasets.language_render import active_at, emitted_at
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        data = LeRobotDataset(root.name, root=root, video_backend="pyav")
        assert data.hf_dataset.features["language_events"] == language_events_column_feature()
        for index in range(len(data)):
            item = data[index]
            said, events, at_s = item["language_persistent"], item["language_events"], float(item["timestamp"])
            for name in ("language_persistent", "language_events"):
                for row in item[name]:
                    assert column_for_style(row["style"]) == name
                    validate_camera_field(row["style"], row["camera"])
            begun = [row for row in said if row["style"] == "motion" and row["timestamp"] <= at_s]
            assert active_at(at_s, persistent=said, style="motion") == begun[-1]
            found = emitted_at(at_s, persistent=said, events=events, style="trace", camera=CAMERA)
            step = int(item["frame_index"])
            source = told(item["episode_id"])
            begins = step % 10 == 0 and step + 4 < len(source)
            assert (found and found["content"]) == (trace(step, len(source)) if begins else None)

    def test_lerobot_renders_a_rewrite_and_the_active_subtask(root: Path) -> None:
        from lerobot.configs.recipe import MessageTurn, TrainingRecipe
        from lerobot.datasets.language import language_persistent_column_feature
        from lerobot.datasets.language_render import active_at, emitted_at, render_sample
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        data = LeRobotDataset(root.name, root=root, video_backend="pyav")
        assert data.hf_dataset.features["language_persistent"] == language_persistent_column_feature()
        recipe = TrainingRecipe(
            messages=[
                MessageTurn(role="user", content="${task}", stream="high_level"),
                MessageTurn(role="assistant", content="${subtask}", stream="low_level", target=True),
            ],
        )
        prompts: dict[bool, set[str]] = {True: set(), False: set()}
        for index in range(len(data)):
            item = data[index]
            said, at_s, step = item["language_persistent"], float(item["timestamp"]), int(item["frame_index"])
            expected = [one for one in SUBTASKS if one.step <= step][-1].text
            assert active_at(at_s, persistent=said, style="subtask")["content"] == expected
            emitted_at(at_s, persistent=said, events=[], style="subtask")  # fails where two are as near
            context = {"task": item["task"]}
            shown = render_sample(
                recipe=recipe, persistent=said, events=None, t=at_s, sample_idx=index, dataset_ctx=context
            )
            prompt, answer = shown["messages"]
            assert answer["content"] == expected
            prompts[int(item["episode_index"]) < 4].add(prompt["content"])
        instructions = {episode(one).instruction for one in IDS}
        assert {*REWRITES} <= prompts[True] <= {*REWRITES, *instructions}
        assert prompts[False] <= instructions
