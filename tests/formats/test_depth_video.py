"""Depth as video: in the codes that lerobot 0.6.1 defines, and where that is installed, as it reads them."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from packaging.version import Version
from synthetic import IDS, NAME, episodes, files, loop, with_extras

from pipeline.config import load
from pipeline.episode_schema import Content
from pipeline.errors import PipelineError
from pipeline.formats.lerobot import LeRobot, LeRobotConfig, depth
from pipeline.formats.read_back import Copy
from pipeline.run.export import export
from pipeline.types import Episode
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS

LEROBOT = Version(version("lerobot"))

CONTENT = Content(extras=("depth", "segmentation"))
COLUMNS = {"image": "observation.images.image_depth", "wrist_image": "observation.images.image2_depth"}


def with_maps(episode_id: str) -> Episode:
    """Return an episode with depth and segmentation alone."""
    source = with_extras(episode_id)
    geometry = {view: replace(each, boxes=None) for view, each in source.geometry.items()}
    return replace(source, object_poses=None, geometry=geometry)


def depth_m(episode: Episode, view: str) -> NDArray[np.float64]:
    """Decode the stored depth of all steps, (T, H, W) in m."""
    packed = episode.geometry[view].maps["depth"]
    maps = [np.asarray(cv2.imdecode(np.frombuffer(each, np.uint8), -1), np.float64) for each in packed]
    return np.stack(maps) / 10_000


def half_a_code_m(distance_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest error of 4095 logarithmic steps from 0.01 to 10 m, which are shifted by 3.5 m."""
    return np.asarray((distance_m + 3.5) * np.expm1(0.5 / 4095 * np.log(13.5 / 3.51)) + 1e-6)


def write(out: Path, frames: str = "video") -> LeRobot:
    # Rejected when a configuration is read where lerobot is older; the writer asks nothing of lerobot.
    options = LeRobotConfig(name=NAME, shards=3).model_copy(update={"depth": "video", "frames": frames})
    dataset = LeRobot(out, options, CONTENT)
    export(dataset, episodes(with_maps), loop)
    return dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> LeRobot:
    return write(tmp_path_factory.mktemp("depth"))


def video_maps(dataset: LeRobot, view: str) -> dict[str, NDArray[np.uint16]]:
    """Decode the codes of every episode with PyAV, by the frames' order alone."""
    codes = {}
    for number, file in enumerate(sorted((dataset.root / "videos" / COLUMNS[view]).rglob("*.mp4"))):
        with av.open(str(file)) as video:
            frames = [frame.to_ndarray(format="gray12le") for frame in video.decode(video=0)]
        steps = pq.read_table(dataset.root / f"data/chunk-000/file-{number:03d}.parquet")["episode_id"].to_pylist()
        assert len(frames) == len(steps)
        for episode_id in dict.fromkeys(steps):
            first = steps.index(episode_id)
            codes[episode_id] = np.stack(frames[first : first + steps.count(episode_id)])
    return codes


def test_info_states_the_codes_as_lerobot_does(dataset: LeRobot) -> None:
    """``get_video_info`` of ``lerobot/datasets/video_utils.py`` in 0.6.1, with a ``DepthEncoderConfig``."""
    features = json.loads((dataset.root / "meta" / "info.json").read_text())["features"]
    for column in COLUMNS.values():
        feature = features[column]
        assert (feature["dtype"], feature["shape"]) == ("video", [256, 256, 1])
        assert feature["names"] == ["height", "width", "channels"]
        stated = feature["info"]
        assert (stated["is_depth_map"], stated["depth_unit"]) == (True, "m")
        limits = {"depth_min": 0.01, "depth_max": 10.0, "shift": 3.5, "use_log": True}
        assert {name: stated[f"video.{name}"] for name in limits} == limits
        assert [stated[f"video.{name}"] for name in ("codec", "pix_fmt", "channels")] == ["hevc", "gray12le", 1]
    assert "camera.agent.depth" not in features
    assert "camera.agent.segmentation" in features


@pytest.mark.parametrize("view", COLUMNS)
def test_every_map_is_within_half_a_code(dataset: LeRobot, view: str) -> None:
    codes = video_maps(dataset, view)
    assert codes.keys() == set(IDS)
    for episode_id, stored in codes.items():
        expected_m = np.maximum(depth_m(with_maps(episode_id), view), 0.01)
        # The formula of ``dequantize_depth``, in double precision.
        read_m = np.exp(stored / 4095 * np.log(13.5 / 3.51) + np.log(3.51)) - 3.5
        assert (np.abs(read_m - expected_m) <= half_a_code_m(expected_m)).all()


def test_a_map_is_at_most_one_map_from_a_key_frame(dataset: LeRobot) -> None:
    for file in (dataset.root / "videos" / COLUMNS["image"]).rglob("*.mp4"):
        with av.open(str(file)) as video:
            keys = [frame.key_frame for frame in video.decode(video=0)]
        assert all(first or second for first, second in pairwise(keys))


def test_statistics_are_in_metres_over_all_pixels(dataset: LeRobot) -> None:
    stated = json.loads((dataset.root / "meta" / "stats.json").read_text())
    for view, column in COLUMNS.items():
        pixels_m = np.concatenate([depth_m(with_maps(episode_id), view) for episode_id in IDS])
        expected = {name: getattr(pixels_m, name)() for name in ("min", "max", "mean", "std")}
        shares = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
        for name, share in shares.items():
            expected[name] = np.quantile(pixels_m, share, method="inverted_cdf")
        assert stated[column]["count"] == [len(pixels_m)]
        for name, figure in expected.items():
            assert np.shape(stated[column][name]) == (1, 1, 1)
            assert np.ravel(stated[column][name])[0] == pytest.approx(figure, rel=1e-9), name


@pytest.mark.slow
def test_the_bytes_are_the_same_each_time(dataset: LeRobot, tmp_path: Path) -> None:
    assert files(write(tmp_path).root) == files(dataset.root)


def test_the_bytes_name_no_processor(dataset: LeRobot) -> None:
    for file in (dataset.root / "videos" / COLUMNS["image"]).rglob("*.mp4"):
        assert b"cpuid" not in file.read_bytes()


def copied(dataset: LeRobot, episode_id: str) -> Copy:
    copy = dataset.read({"episode_id": episode_id})
    assert copy is not None
    return copy


def findings(check: str, made: Episode, copy: Copy, decodes_all_frames: bool = True) -> list[str]:
    no_replay: Any = None
    case = Case({"instruction": made.instruction}, made, no_replay, [copy], None, decodes_all_frames)
    assert CHECKS[check].applies(case)
    return [fault.what for fault in CHECKS[check].find(case)]


@pytest.mark.parametrize("episode_id", IDS)
def test_the_reader_finds_no_fault(dataset: LeRobot, episode_id: str) -> None:
    made, copy = with_maps(episode_id), copied(dataset, episode_id)
    assert {view for view, _ in copy.depth_m} == {*COLUMNS}
    for check in ("depth", "geometry", "statistics"):
        for decodes_all_frames in (True, False):
            assert findings(check, made, copy, decodes_all_frames) == []


def test_other_depth_is_found(dataset: LeRobot) -> None:
    made, copy = with_maps(IDS[1]), copied(dataset, IDS[1])
    place = ("image", 0)
    # A pixel that is a whole code away.
    other_m = copy.depth_m[place].copy()
    other_m[3, 5] *= 1.002
    found = findings("depth", made, replace(copy, depth_m={**copy.depth_m, place: other_m}))
    assert [text.split(" differs")[0] for text in found] == ["image_depth of step 0"]
    exchanged = {place: copy.depth_m["wrist_image", 0]}
    assert findings("depth", made, replace(copy, depth_m={**copy.depth_m, **exchanged}))


def halve(figures: dict[str, Any]) -> None:
    figures["mean"] = [[[figures["mean"][0][0][0] / 2]]]


def miscount(figures: dict[str, Any]) -> None:
    figures["count"] = [figures["count"][0] + 1]


def be_in_millimetres(figures: dict[str, Any]) -> None:
    for name in ("min", "max", "mean", "std", "q01", "q10", "q50", "q90", "q99"):
        figures[name] = [[[1000 * figures[name][0][0][0]]]]


def lose_the_range(figures: dict[str, Any]) -> None:
    del figures["min"]


@pytest.mark.parametrize("plant", [halve, miscount, be_in_millimetres, lose_the_range])
def test_other_statistics_are_found(dataset: LeRobot, plant: Callable[[dict[str, Any]], None]) -> None:
    made, copy = with_maps(IDS[2]), copied(dataset, IDS[2])
    assert copy.statistics is not None
    stored = json.loads(json.dumps(copy.statistics.stored))
    plant(stored[COLUMNS["image"]])
    wrong = replace(copy, statistics=replace(copy.statistics, stored=stored))
    assert all("image_depth" in text for text in findings("statistics", made, wrong))
    assert findings("statistics", made, wrong)


def test_a_cut_video_is_found(dataset: LeRobot, tmp_path: Path) -> None:
    shutil.copytree(dataset.root, tmp_path / "lerobot" / NAME)
    spoiled = LeRobot(tmp_path, dataset.options, CONTENT)
    (file, *_) = sorted((spoiled.root / "videos" / COLUMNS["image"]).rglob("*.mp4"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(PipelineError, match=r"LeRobot v3\.0"):
        spoiled.read({"episode_id": IDS[0]})


def test_without_the_option_depth_is_text(tmp_path: Path) -> None:
    plain = LeRobot(tmp_path, LeRobotConfig(name=NAME), CONTENT)
    assert "depth" not in plain.options.model_dump()
    assert plain.keys["image_depth"] == "camera.agent.depth"
    assert not plain.card_facts.has_depth_video


CONFIG = (
    "{{name: deep, plan: {{episodes: {{camera: 1}}}}, render: {{extras: [{}]}}, export: {{lerobot: {{depth: video}}}}}}"
)


# lerobot reads such depth from 0.6 on.
if Version("0.6") > LEROBOT:

    def test_a_lerobot_that_cannot_read_it_is_reported_before_any_work(tmp_path: Path) -> None:
        file = tmp_path / "deep.yaml"
        file.write_text(CONFIG.format("depth"))
        with pytest.raises(PipelineError, match=r"export\.lerobot\.depth: .*lerobot 0\.4\.4.*Python 3\.12"):
            load(file)

else:

    def test_an_option_without_depth_is_rejected(tmp_path: Path) -> None:
        file = tmp_path / "deep.yaml"
        file.write_text(CONFIG.format("segmentation"))
        with pytest.raises(PipelineError, match=r"export\.lerobot\.depth: video requires depth in render\.extras"):
            load(file)
        file.write_text(CONFIG.format("depth"))
        options = load(file).export.options_for(LeRobot)
        assert options is not None
        assert options.depth == "video"

    def test_the_codes_are_lerobots() -> None:
        from lerobot.datasets.depth_utils import dequantize_depth, quantize_depth

        depths = np.arange(65536, dtype=np.uint16).reshape(256, 256)
        theirs = quantize_depth((depths / 10_000).astype(np.float32), video_backend=None)
        ours = depth.codes_of(depths)
        # lerobot computes in single precision.
        assert np.abs(ours.astype(int) - theirs).max() <= 1
        assert (ours != theirs).sum() <= 20
        read_m = dequantize_depth(ours, output_unit="m", output_tensor=False)[0]
        assert np.abs(read_m - depth.metres_of(ours)).max() < 1e-5

    def test_info_is_what_lerobot_states_of_such_a_video(dataset: LeRobot) -> None:
        from lerobot.configs.video import DepthEncoderConfig
        from lerobot.datasets.video_utils import get_video_info

        features = json.loads((dataset.root / "meta" / "info.json").read_text())["features"]
        stated = features[COLUMNS["image"]]["info"]
        encoder = DepthEncoderConfig.from_video_info(stated)
        (file, *_) = (dataset.root / "videos" / COLUMNS["image"]).rglob("*.mp4")
        theirs = get_video_info(file, video_encoder=encoder)
        assert {name: theirs[name] for name in stated if name != "depth_unit"} == {
            name: value for name, value in stated.items() if name != "depth_unit"
        }

    @pytest.mark.parametrize("frames", ["video", "images"])
    def test_lerobot_reads_metres(tmp_path: Path, frames: str) -> None:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        root = write(tmp_path, frames).root
        data = LeRobotDataset(root.name, root=root, video_backend="pyav", depth_output_unit="m")
        assert set(data.meta.depth_keys) == {*COLUMNS.values()}
        ids = pq.read_table(root / "meta" / "provenance.parquet")["episode_id"].to_pylist()
        for index in range(0, len(data), 5):
            item = data[index]
            made = with_maps(ids[int(item["episode_index"])])
            for view, column in COLUMNS.items():
                expected_m = np.maximum(depth_m(made, view)[int(item["frame_index"])], 0.01)
                errors_m = np.abs(item[column].numpy() - expected_m)
                assert item[column].shape == (1, 256, 256)
                assert (errors_m <= half_a_code_m(expected_m)).all()

    @pytest.mark.parametrize("frames", ["video", "images"])
    def test_the_check_by_lerobot_finds_no_fault(tmp_path: Path, frames: str) -> None:
        dataset = write(tmp_path / "data", frames)
        kept = {episode_id: {"steps": len(with_maps(episode_id)), "demo_id": "task/demo_0"} for episode_id in IDS}
        assert [*dataset.check(kept, tmp_path / "cache")] == []
        stats = dataset.root / "meta" / "stats.json"
        stated = json.loads(stats.read_text())
        be_in_millimetres(stated[COLUMNS["image"]])
        stats.write_text(json.dumps(stated))
        assert {fault.what.split(" is ")[0] for _, fault in dataset.check(kept, tmp_path / "cache")} >= {
            f"mean of {COLUMNS['image']}"
        }
