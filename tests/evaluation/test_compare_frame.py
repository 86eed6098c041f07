"""``dataset compare-frame`` names the causes of differences, and no others, for frames of other simulators."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import frame_causes
import numpy as np
import pytest

from pipeline.__main__ import main
from pipeline.errors import PipelineError
from pipeline.evaluation.first_observation import picture_fit
from pipeline.evaluation.first_observation.frame_report import Report, write_sheet
from pipeline.evaluation.first_observation.picture_points import find_transformation
from pipeline.evaluation.first_observation.start_frames import LastStartFrames

CASES = {case.name: case for case in frame_causes.cases()}

CHOSEN = (
    "object: MuJoCo 3.3.3",
    "object: MuJoCo 3.8.1, rotated 180, 224",
    "object: mirrored",
    "object: rendered with 360 pixels",
    "goal: MuJoCo 3.3.3",
    "goal: steps0, rotated 180",
    "goal: gripper1",
    "goal: seed7",
    "goal: state3",
    "goal: wrist",
    "goal: camera shifted",
    "spatial: MuJoCo 3.8.1",
)
"""Cases of ``benchmarks/frame_causes.py`` in the tests; the script runs all of them."""


@pytest.fixture(scope="module")
def opened() -> Iterator[LastStartFrames]:
    frames = LastStartFrames()
    yield frames
    frames.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", CHOSEN)
def test_the_causes_are_reported_and_no_others(name: str, opened: LastStartFrames) -> None:
    report = frame_causes.reported(CASES[name], opened)
    assert {finding.cause for finding in report.findings} == CASES[name].causes, report.lines()


@pytest.mark.slow
def test_frames_of_mujoco_3_1_6_are_ours_to_the_pixel(opened: LastStartFrames) -> None:
    report = frame_causes.reported(CASES["goal: MuJoCo 3.1.6"], opened)
    assert report.equal
    assert report.difference < 0.001


@pytest.mark.slow
def test_a_resizing_is_named(opened: LastStartFrames) -> None:
    """Halves by INTER_LINEAR and INTER_AREA are equal, so neither is named."""
    named = {
        "goal: 224 by area": "INTER_AREA",
        "goal: 128 by linear": "resized or rendered in this size",
    }
    for case, method in named.items():
        (finding,) = frame_causes.reported(CASES[case], opened).findings
        assert finding.cause == "size"
        assert method in finding.what


@pytest.mark.slow
def test_a_sheet_shows_picture_frame_and_difference_and_replaces_no_file_of_the_user(
    opened: LastStartFrames, tmp_path: Path
) -> None:
    report: Report = frame_causes.reported(CASES["goal: rotated 180"], opened)
    sheet = tmp_path / "sheet.png"
    write_sheet(report, sheet)
    picture, frame, apart = np.split(np.asarray(cv2.imread(str(sheet))), 3, axis=1)
    assert np.array_equal(picture, frame_causes.frame("3.1.6-goal-agentview"))
    assert np.abs(picture.astype(int) - frame).mean() < 0.001
    assert apart.max() <= 4
    write_sheet(report, sheet)
    sheet.write_bytes(b"mine")
    with pytest.raises(PipelineError, match=r"sheet\.png: the command would overwrite the file"):
        write_sheet(report, sheet)
    assert sheet.read_bytes() == b"mine"


@pytest.mark.slow
def test_the_command_exits_with_1_if_the_frames_differ(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    task = frame_causes.TASKS["goal"]
    upside_down = tmp_path / "first.png"
    cv2.imwrite(str(upside_down), cv2.flip(frame_causes.frame("3.1.6-goal-agentview"), 0))
    assert called(monkeypatch, str(frame_causes.FRAMES / "3.1.6-goal-agentview.png"), task) == 0
    assert "equal: " in capsys.readouterr().out
    assert called(monkeypatch, str(upside_down), task, "--json") == 1
    result = json.loads(capsys.readouterr().out)
    assert [finding["cause"] for finding in result["findings"]] == ["orientation"]
    assert "image[::-1]" in result["findings"][0]["remedy"]
    assert called(monkeypatch, str(upside_down), task, "--init-state", "50") == 1
    assert "a number from 0 to 49" in capsys.readouterr().err


def called(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["pipeline", "dataset", "compare-frame", *arguments])
    return main()


ORIENTED: dict[str, Callable[[frame_causes.Image], object]] = {
    "image[::-1, ::-1]": lambda image: cv2.rotate(image, cv2.ROTATE_180),
    "image[:, ::-1]": lambda image: cv2.flip(image, 1),
    "image[::-1]": lambda image: cv2.flip(image, 0),
    "np.rot90(image)": lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE),
    "np.rot90(image, -1)": lambda image: cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE),
    "image.swapaxes(0, 1)": cv2.transpose,
    "image[::-1, ::-1].swapaxes(0, 1)": lambda image: cv2.rotate(cv2.transpose(image), cv2.ROTATE_180),
}
"""Code of a remedy to the change that it undoes, by OpenCV."""


@pytest.mark.parametrize("code", ORIENTED)
def test_the_code_of_a_remedy_undoes_the_orientation(code: str) -> None:
    clean = frame_causes.frame("3.1.6-goal-agentview")
    picture = np.asarray(ORIENTED[code](clean), np.uint8)
    (orientation,) = (candidate for candidate in picture_fit.ORIENTATIONS if candidate.code == code)
    assert np.array_equal(eval(code, {"image": picture, "np": np}), clean)
    assert np.array_equal(orientation.undo(picture), clean)


def test_pictures_that_cannot_be_compared_are_rejected(tmp_path: Path) -> None:
    grey, small = np.full((256, 256, 3), 99, np.uint8), np.zeros((40, 300, 3), np.uint8)
    text = tmp_path / "text.png"
    text.write_text("no picture")
    for name, picture in (("grey", grey), ("small", small)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), picture)
    for file, words in {
        "text.png": "not a picture",
        "none.png": "no such file",
        "small.png": "300 x 40",
        "grey.png": "no colours",
    }.items():
        with pytest.raises(PipelineError, match=words):
            picture_fit.read_picture(tmp_path / file)


def test_points_show_a_moved_camera_but_not_moved_things() -> None:
    clean = frame_causes.frame("3.1.6-goal-agentview")
    turn = cv2.getRotationMatrix2D((128, 128), 10, 1.1)
    turned = np.asarray(cv2.warpAffine(clean, turn, (256, 256), borderMode=cv2.BORDER_REFLECT), np.uint8)
    placed = find_transformation(turned, clean)
    assert placed is not None
    assert placed.moved
    assert placed.scale == pytest.approx(1.1, abs=0.02)
    assert abs(placed.rotation_deg) == pytest.approx(10, abs=0.5)
    other_state = find_transformation(frame_causes.frame("3.1.6-goal-agentview-state3"), clean)
    assert other_state is None or other_state.still
