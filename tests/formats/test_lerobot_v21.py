"""LeRobot v2.1 has the names, files and gripper of the convention that was asked for, whoever writes it."""

import json
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from every_set import MIN_PSNR_DB, pixels, psnr_db, spread
from numpy.typing import NDArray
from synthetic import EXTRAS, IDS, REPO, SET, episode, files, with_extras, write_lerobot_v21

from pipeline.episode_schema import Content
from pipeline.formats import lerobot
from pipeline.formats.episodes import Piece
from pipeline.formats.lerobot import write_v21
from pipeline.formats.lerobot.columns import CONVENTIONS, Layout

V21 = {
    "ipec": (SET, "observation.images.image", "observation.images.wrist_image", "observation.state", "action"),
    "openpi": (REPO, "image", "wrist_image", "state", "actions"),
}
"""Convention to its set and its columns."""


def test_the_entries_of_poses_and_boxes_are_named_row_by_row() -> None:
    columns = Layout(Content(extras=EXTRAS), CONVENTIONS["ipec"], "video").described
    poses, boxes = columns["object_poses"]["names"], columns["camera.agent.boxes"]["names"]
    assert (len(poses), len(boxes)) == (24 * 7, 24 * 4)
    assert poses[:8] == ["0_x_m", "0_y_m", "0_z_m", "0_w", "0_x", "0_y", "0_z", "1_x_m"]
    assert boxes[:5] == ["0_x_px", "0_y_px", "0_width_px", "0_height_px", "1_x_px"]
    assert (poses[-1], boxes[-1]) == ("23_z", "23_height_px")


@pytest.mark.parametrize(("episodes", "chunks"), [(1, 1), (1000, 1), (1001, 2)])
def test_a_chunk_has_a_thousand_episodes(
    episodes: int, chunks: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without files of episodes, whose common files are left out."""
    (tmp_path / "piece").mkdir()
    for name in write_v21.LINES:
        (tmp_path / "piece" / name).write_text("")
    monkeypatch.setattr(write_v21, "write_common", lambda *_: {})
    piece = Piece("piece", [f"episode-{number}" for number in range(episodes)], steps=episodes)
    write_v21.finish(tmp_path, tmp_path / "set", [piece], Layout(Content(), CONVENTIONS["openpi"], "images"))
    assert json.loads((tmp_path / "set" / "meta" / "info.json").read_text())["total_chunks"] == chunks


@pytest.mark.parametrize("convention", V21)
def test_v21_has_the_conventions_names_and_gripper(convention: str, tmp_path: Path) -> None:
    root = write_lerobot_v21(tmp_path, convention).folder / V21[convention][0]
    _, image, wrist, state, action = V21[convention]
    info = json.loads((root / "meta" / "info.json").read_text())
    lines = {
        name: [json.loads(line) for line in (root / "meta" / f"{name}.jsonl").read_text().splitlines()]
        for name in ("episodes", "episodes_stats", "tasks")
    }
    tasks = {line["task_index"]: line["task"] for line in lines["tasks"]}
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v2.1", 20, len(IDS))
    assert info["total_frames"] == sum(len(episode(one)) for one in IDS)
    videos = {"ipec": 2 * len(IDS), "openpi": 0}
    assert (info["total_chunks"], info["total_videos"]) == (1, videos[convention])
    before = 0
    for index, source in enumerate(map(episode, IDS)):
        place = {"episode_chunk": 0, "episode_index": index}
        table = pq.read_table(root / info["data_path"].format(**place))
        commands = source.action.copy()
        if convention == "ipec":
            commands[:, 6] = np.where(commands[:, 6] < 0, 1, 0)
        np.testing.assert_array_equal(np.stack(table[action].to_numpy()), commands)
        np.testing.assert_array_equal(np.stack(table[state].to_numpy()), source.state)
        np.testing.assert_array_equal(table["index"].to_numpy(), before + np.arange(len(source)))
        np.testing.assert_allclose(table["timestamp"].to_numpy(), np.arange(len(source)) / 20, atol=1e-6)
        assert {tasks[task] for task in table["task_index"].to_pylist()} == {source.instruction}
        assert lines["episodes"][index]["tasks"] == [source.instruction]
        assert (lines["episodes"][index]["length"], lines["episodes"][index]["episode_id"]) == (len(source), IDS[index])
        assert_close(lines["episodes_stats"][index]["stats"][action], commands)
        for view, key in (("image", image), ("wrist_image", wrist)):
            if convention == "openpi":
                assert [row["bytes"] for row in table[key].to_pylist()] == source.frames[view]
            else:
                shown = decoded(root / info["video_path"].format(video_key=key, **place))
                assert len(shown) == len(source)
                assert min(map(psnr_db, shown, map(pixels, source.frames[view]))) > MIN_PSNR_DB
        before += len(source)
    # Newer versions of datasets call it a List, which those of the clients do not know.
    assert b'"List"' not in pq.read_schema(root / info["data_path"].format(**place)).metadata[b"huggingface"]


def test_starvla_finds_the_statistics_that_it_would_compute(tmp_path: Path) -> None:
    """By ``calculate_dataset_statistics`` and ``_load_stats_cache`` of its loader at 0ed0aad."""
    root = write_lerobot_v21(tmp_path, "ipec").folder / SET
    cache = json.loads((root / "meta" / "stats_gr00t.json").read_text())
    assert (cache["__format_version"], cache["__cache_config"]) == (2, {"mode": "abs"})
    modality = json.loads((root / "meta" / "modality.json").read_text())
    named = {entry["original_key"] for kind in ("state", "action") for entry in modality[kind].values()}
    assert cache["statistics"].keys() == named == {"observation.state", "action"}
    frames = [pq.read_table(file) for file in sorted(root.glob("data/*/*.parquet"))]
    for column, figures in cache["statistics"].items():
        rows = [row for frame in frames for row in frame[column].to_pylist()]
        values = np.vstack([np.asarray(row, dtype=np.float32) for row in rows])
        expected = {name: getattr(np, name)(values, axis=0) for name in ("mean", "std", "min", "max")}
        expected |= {"q01": np.quantile(values, 0.01, axis=0), "q99": np.quantile(values, 0.99, axis=0)}
        assert figures.keys() == expected.keys()
        for name, figure in expected.items():
            np.testing.assert_allclose(figures[name], figure, atol=1e-5, err_msg=f"{name} of {column}")


def test_openpi_has_no_files_of_starvla(tmp_path: Path) -> None:
    meta = write_lerobot_v21(tmp_path, "openpi").folder / REPO / "meta"
    assert not {"modality.json", "stats_gr00t.json"} & {file.name for file in meta.iterdir()}


def assert_close(found: Mapping[str, Any], values: NDArray[Any]) -> None:
    assert set(found) == {"min", "max", "mean", "std", "count"}
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(found[name], getattr(values.astype(np.float64), name)(axis=0), atol=1e-6)
    assert found["count"] == [len(values)]


def decoded(file: Path) -> list[NDArray[np.uint8]]:
    with av.open(str(file)) as video:
        return [np.asarray(frame.to_ndarray(format="rgb24"), np.uint8) for frame in video.decode(video=0)]


@pytest.mark.slow
@pytest.mark.parametrize("convention", V21)
def test_v21_does_not_depend_on_workers_and_keeps_extras(convention: str, tmp_path: Path) -> None:
    one = write_lerobot_v21(tmp_path / "one", convention, with_extras, extras=EXTRAS)
    with (
        pytest.MonkeyPatch.context() as patch,
        ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor,
    ):
        patch.setattr(lerobot, "EPISODES_OF_A_PIECE", 1)
        run = partial(spread, executor)
        two = write_lerobot_v21(tmp_path / "two", convention, with_extras, run, EXTRAS)
        # Another number of pieces, and so another identity, but the same files.
        assert files(one.folder) == files(two.folder)
    kept = {episode_id: {"episode_id": episode_id, "demo_id": episode_id} for episode_id in IDS}
    assert list(two.check(kept, tmp_path)) == []
    for episode_id in IDS:
        source, copy = with_extras(episode_id), two.read(kept[episode_id])
        assert copy is not None
        np.testing.assert_array_equal(copy.episode.action, source.action)
        np.testing.assert_array_equal(copy.episode.object_poses, source.object_poses)
        np.testing.assert_array_equal(copy.episode.geometry["image"].boxes, source.geometry["image"].boxes)
        assert copy.episode.geometry["image"].maps["depth"] == list(source.geometry["image"].maps["depth"])
        np.testing.assert_array_equal(copy.episode.geometry["image"].extrinsics, source.geometry["image"].extrinsics)
