"""Checks of an episode in all places that store it: each is a small function that yields the errors it finds."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.axes import TextPerturbation, from_json, of_layer
from pipeline.axes.language import LanguagePerturbation, list_rewrites
from pipeline.catalogue.scene_files import portable
from pipeline.episode_check import label_faults
from pipeline.episode_schema import MATRICES, MOTION, SCHEMA, labels_of
from pipeline.errors import PipelineError
from pipeline.formats.annotations import event_annotations, persistent_annotations
from pipeline.formats.read_back import Copy, Fault, sampled
from pipeline.formats.stated_statistics import FIGURES, complete, wrong_depth, wrong_numbers, wrong_pixels, wrong_sample
from pipeline.images.jpeg import decode, decode_exactly
from pipeline.libero.carried import definition_of
from pipeline.libero.tasks import WITHOUT_DEBRIS, debris, exceeds_step_limit
from pipeline.run.manifest import OWN_VERSION
from pipeline.run.manifest import labels_of as labels_of_row
from pipeline.types import Frame
from pipeline.validation.case import Case

VIDEO_PSNR_DB = 32.0
"""Least PSNR, in grey, of a video's frame to the stored JPEG; the least of pans over 30 procedural maps was 37.0.

In colour it can be 20: a video stores colours at half the resolution, which shows on fine, colourful surfaces."""

COLOURS_OFF = 0.5
"""Share of a stored frame's colourfulness by which a video's colours may differ; the most of 3,843 frames was 0.14.
Grey frames differ by 1, and frames with red and blue exchanged differ by more."""

PALE_LEVELS = 4.0
"""Least colourfulness assumed of a frame: mean distance of Cb and Cr from grey, in levels, over 16 by 16 fields."""

STILL_LEVELS = 0.5
"""Mean difference in grey levels up to which two frames count as equal; the least of 532 episodes was 1.2."""

FAR_STILL_LEVELS = 0.1
"""``STILL_LEVELS`` of further views; in the gallery view, which is far from the robot, the least of seven episodes was
0.6."""

BLANK_LEVELS = 5.0
"""Standard deviation in grey levels below which a frame counts as blank; the least of 532 episodes, which
have up to seven perturbed axes, was 19."""

RESPONSE_STEPS = 8
"""Number of steps (0.4 s) in which the fingers respond to a change of the command.

At other times contacts may move them against it: the stove's knob opened closed fingers, and closed open ones, by 0.075
m in all."""

AGAINST_M = 0.01
"""Sum of the distances that the fingers may move against the command in ``RESPONSE_STEPS`` after its changes.

In each of 1,500 episodes with changes they moved 0.005 m or more with it, and 0.02 m or more in 99 % of them."""


def _chroma(frame: Frame) -> NDArray[np.float64]:
    """Return Cb and Cr relative to grey, in levels, over 16 by 16 fields: (16, 16, 2)."""
    fields = cv2.resize(frame, (16, 16), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(fields, cv2.COLOR_RGB2YCrCb)[..., 1:].astype(float) - 128


def _colours_off(frame: Frame, stored: Frame) -> float:
    """Return the mean difference of Cb and Cr, as a share of the stored frame's mean distance from grey."""
    chroma, expected = _chroma(frame), _chroma(stored)
    return float(np.abs(chroma - expected).mean() / max(np.abs(expected).mean(), PALE_LEVELS))


def length(case: Case) -> Iterator[Fault]:
    """Check that every place has as many steps as the replay executed."""
    steps = len(case.trajectory.actions)
    places = [("manifest", case.row["steps"]), ("frames", len(case.made))]
    places += [(copy.dataset, len(copy)) for copy in case.copies]
    for dataset, number in places:
        if number != steps:
            yield case.finding(dataset, f"has {number} steps", steps)


ARM = slice(1, 8)
"""Joint angles in a flattened state, after the time: LIBERO's robot comes first in every scene."""


GRIP_IN_HAND = Rotation.from_euler("z", -90, degrees=True)
"""Orientation of the grip site, which the controller moves, in the hand, whose orientation the state has."""

GOAL_TOLERANCE = 1e-5
"""Largest difference of goals in m and rad; state and goal are rounded to float32."""


def motion(case: Case) -> Iterator[Fault]:
    """Check actions, states and joint angles, bit for bit; actions and joint angles must be the replay's."""
    replay = case.trajectory
    if not _same(case.made.joint_state, replay.states[:-1, ARM].astype(np.float32)):
        yield case.finding("frames", "has other joint angles", "the joint angles of the replay")
    if not _same(case.made.action, replay.actions.astype(np.float32)):
        yield case.finding("frames", "has other actions", "the actions of the replay")
    else:
        yield from _goals(case)
    for copy in case.copies:
        # Copies of another length cannot be compared; ``length`` reports them.
        for name in MOTION if len(copy) == len(case.made) else ():
            values, made = getattr(copy.episode, name), getattr(case.made, name)
            if (values.shape, values.dtype) != (made.shape, made.dtype):
                what, expected = f"{values.shape} of {values.dtype}", f"{made.shape} of {made.dtype}"
                yield case.finding(copy.dataset, f"{name} is {what}", expected)
            elif not _same(values, made):
                step = next(t for t in range(len(made)) if not _same(values[t], made[t]))
                what = f"{name} of step {step} is {values[step].tolist()}"
                yield case.finding(copy.dataset, what, made[step].tolist())
        yield from _replay(case, copy)


def _replay(case: Case, copy: Copy) -> Iterator[Fault]:
    """Compare the states and the scene that a dataset stores with the replay's, bit for bit."""
    stored, trajectory = copy.episode.replay, case.trajectory
    if stored is None:
        return
    if not _same(stored.actions, trajectory.actions):
        yield case.finding(copy.dataset, "has other actions in double precision", "the actions of the replay")
    if not _same(stored.states, trajectory.states[:-1]):
        yield case.finding(copy.dataset, "has other states", "the states of the replay before each action")
    scene, expected = stored.scene, trajectory.scene
    if scene.model_xml != portable(expected.model_xml):
        yield case.finding(copy.dataset, "has another scene in model_file", "the scene of the replay")
    if not _same(scene.state, expected.state) or scene.start != expected.start:
        yield case.finding(copy.dataset, "has another start", "the start of the replay")
    if stored.origin_sha256 != case.row["demo_origin_sha256"]:
        yield case.finding(copy.dataset, f"origin_sha256 is {stored.origin_sha256}", case.row["demo_origin_sha256"])


def _goals(case: Case) -> Iterator[Fault]:
    """Compare the absolute actions with state and delta of their step.

    The goal of the orientation is compared at steps that turn the hand; at others, it is a former goal.
    """
    made, spec = case.made, SCHEMA.action
    deltas = np.clip(made.action[:, :6].astype(float), *spec.range) * spec.units
    goals = made.action_absolute.astype(float)
    positions_m = made.state[:, :3] + deltas[:, :3]
    turns = np.any(deltas[:, 3:] != 0, axis=1)
    hands = Rotation.from_rotvec(made.state[:, 3:6]) * GRIP_IN_HAND
    apart = Rotation.from_rotvec(goals[:, 3:6]).inv() * Rotation.from_rotvec(deltas[:, 3:]) * hands
    if np.abs(goals[:, :3] - positions_m).max() > GOAL_TOLERANCE:
        yield case.finding("frames", "action_absolute has other positions", "state plus delta")
    if np.any(apart.magnitude()[turns] > GOAL_TOLERANCE):
        yield case.finding("frames", "action_absolute has other orientations", "state turned by delta")
    if not _same(made.action_absolute[:, 6], made.action[:, 6]):
        yield case.finding("frames", "action_absolute has other gripper commands", "those of action")


def instruction(case: Case) -> Iterator[Fault]:
    """Check the instruction at every step, and lerobot's language columns."""
    for copy in case.whole:
        wrong = set(copy.instructions) - {case.row["instruction"]}
        if wrong:
            yield case.finding(copy.dataset, f"instruction {min(wrong)!r}", repr(case.row["instruction"]))
        yield from _language(case, copy)


def _language(case: Case, copy: Copy) -> Iterator[Fault]:
    """Check the entries of the language columns, at the first step of each column that has others."""
    expected = _language_entries(case, copy.train)
    for step, stored in enumerate(copy.said or ()):
        entries = [(*_spoken(row), np.float32(row["timestamp"]), row["camera"]) for row in stored]
        if entries != expected:
            yield _other_entries(case, copy, f"language column of step {step}", entries, expected)
            break
    if copy.events is None:
        return
    size_px = next(iter(case.stored["image"].frames.values())).shape[0]
    traces = event_annotations(case.made, size_px)
    for step, stored in enumerate(copy.events):
        shown = [(*_spoken(row), row["camera"]) for row in stored]
        here = [(note.role, note.style, note.text, note.camera) for note in traces if note.step == step]
        if shown != here:
            yield _other_entries(case, copy, f"language events of step {step}", shown, here)
            break


def _language_entries(case: Case, train: bool) -> list[tuple[str, str, str, np.float32, None]]:
    """List the persistent entries: the manifest's wordings (in the training split only), subtasks and motions."""
    rewrites = case.made.rewrites if train else ()
    entries: list[tuple[str, str, str, np.float32, None]] = []
    if rewrites:
        texts = dict.fromkeys([case.row["instruction"], *rewrites])
        entries += [("user", "task_aug", text, np.float32(0), None) for text in texts]
    for subtask in case.made.subtasks:
        entries.append(("assistant", "subtask", subtask.text, np.float32(subtask.step / SCHEMA.fps_hz), None))
    for note in persistent_annotations(case.made, train=False):
        if note.style == "motion":
            entries.append((note.role, note.style, note.text, note.time_s, None))
    return entries


def _spoken(row: Mapping[str, Any]) -> tuple[str, str, str]:
    return row["role"], row["style"], row["content"]


def _other_entries(case: Case, copy: Copy, place: str, entries: Sequence[Any], expected: Sequence[Any]) -> Fault:
    strange = [entry for entry in entries if entry not in expected]
    lacking = [entry for entry in expected if entry not in entries]
    return case.finding(copy.dataset, f"{place} has {strange}", lacking)


def labels(case: Case) -> Iterator[Fault]:
    """Check the subtasks and rewrites of the manifest, and compare all copies with the manifest."""
    stated = labels_of_row(case.row)
    if stated is None:
        yield case.finding("manifest", "has no subtasks and rewrites", "lists, which may be empty")
        return
    for what, expected in label_faults(stated, len(case.made)):
        yield case.finding("manifest", what, expected)
    for dataset, episode in (("frames", case.made), *((copy.dataset, copy.episode) for copy in case.copies)):
        for name, stored in labels_of(episode).items():
            if stored != stated[name]:
                yield case.finding(dataset, f"{name} is {stored}", stated[name])


def wording(case: Case) -> Iterator[Fault]:
    """Check that the instruction is the task's or the sampled rewrite of the bank, without parts of a file's name."""
    task, text = case.task, case.row["instruction"]
    expected = task.instruction
    for change in of_layer(from_json(case.row["perturbations"]), TextPerturbation):
        expected = change.apply(expected)
        if isinstance(change, LanguagePerturbation) and change not in list_rewrites(task, bank=case.bank):
            yield case.finding("manifest", f"rewrite {change.text!r} is not in the bank", f"one for {task.name}")
    if text != expected:
        yield case.finding("manifest", f"instruction {text!r}", repr(expected))
    leftover = debris(text)
    if leftover:
        yield case.finding("manifest", f"instruction {text!r} has {leftover!r}", WITHOUT_DEBRIS)


def provenance(case: Case) -> Iterator[Fault]:
    """Check the manifest's provenance.

    This project's version may differ, because a manifest can be newer than its dataset.
    """
    for copy in case.copies:
        for column in case.made.provenance:
            value, expected = copy.episode.provenance.get(column), case.row[column]
            if value != expected and column != OWN_VERSION:
                yield case.finding(copy.dataset, f"{column} is {value!r}", repr(expected))
        for name, (column, value) in copy.repeated.items():
            if value != case.row[column]:
                yield case.finding(copy.dataset, f"{name} is {value!r}", f"{case.row[column]!r}, as {column}")


def results(case: Case) -> Iterator[Fault]:
    """Compute results that the manifest states again from the actions and the start of the replay."""
    actions, row = case.trajectory.actions, case.row
    expected = {
        "actions_sha256": hashlib.sha256(actions.astype(np.float32).tobytes()).hexdigest(),
        "resolved": case.trajectory.resolved,
        "exceeds_step_limit": exceeds_step_limit(row["suite"], len(actions)),
    }
    for column, value in expected.items():
        if row[column] != value:
            yield case.finding("manifest", f"{column} is {row[column]!r}", repr(value))


def place(case: Case) -> Iterator[Fault]:
    """Check that each dataset stores the episode at the place that the manifest states."""
    for copy in case.copies:
        stated = {column: case.row[column] for column in copy.place}
        if stated != copy.place:
            yield case.finding("manifest", _listed(stated), f"{_listed(copy.place)}, its place in the dataset")


def jpeg(case: Case) -> Iterator[Fault]:
    """Check that the image files of a dataset have the bytes of the stored frames, and lossless frames their pixels."""
    for copy in case.copies:
        for view, files in copy.episode.frames.items():
            pairs = zip(files, case.made.frames[view], strict=False)
            wrong = [step for step, (file, stored) in enumerate(pairs) if file != stored]
            if wrong:
                what = f"{view} differs at {len(wrong)} steps, first at {wrong[0]}"
                yield case.finding(copy.dataset, what, "the stored JPEG")
        if copy.lossless_frames is not None:
            yield from _pixels(case, copy, copy.lossless_frames)


def _pixels(case: Case, copy: Copy, frames_of: Callable[[str], Iterator[Frame]]) -> Iterator[Fault]:
    """Compare every frame of a copy with the decoded JPEG file of its step."""
    for view, files in case.made.frames.items():
        try:
            pairs = zip(frames_of(view), files, strict=False)
            wrong = [step for step, (frame, file) in enumerate(pairs) if not np.array_equal(frame, decode(file))]
        except PipelineError as error:
            yield case.finding(copy.dataset, f"{view}: {error}", "frames that can be read")
            continue
        if wrong:
            what = f"{view} has other pixels at {len(wrong)} steps, first at {wrong[0]}"
            yield case.finding(copy.dataset, what, "the pixels of the stored JPEG")


def geometry(case: Case) -> Iterator[Fault]:
    """Check the matrices of the cameras, bit for bit, and the files and numbers of the extras."""
    for copy in case.whole:
        for view, made in case.made.geometry.items():
            for name in MATRICES:
                matrix, expected = getattr(copy.episode.geometry[view], name), getattr(made, name)
                if matrix.dtype != expected.dtype or not np.array_equal(matrix, expected):
                    yield case.finding(copy.dataset, f"{view}_{name} is {matrix.tolist()}", expected.tolist())
            for name, files in made.maps.items():
                if name == "depth" and copy.depth_m:
                    continue  # ``depth`` compares videos.
                if list(copy.episode.geometry[view].maps[name]) != list(files):
                    yield case.finding(copy.dataset, f"{view}_{name} differs", "the stored PNG files")
            if not _same(copy.episode.geometry[view].boxes, made.boxes):
                yield case.finding(copy.dataset, f"{view}_boxes differ", "the stored boxes")
        if not _same(copy.episode.object_poses, case.made.object_poses):
            yield case.finding(copy.dataset, "object_poses differ", "the stored poses")
        if list(copy.episode.instances) != list(case.made.instances):
            yield case.finding(copy.dataset, f"instances {list(copy.episode.instances)}", list(case.made.instances))


DEPTH_SHARE, DEPTH_OFFSET_M = 1.65e-4, 3.5
"""Largest error of lerobot's depth, as a share of the distance plus 3.5 m: half of 4095 codes, which span a factor of
13.5 / 3.51."""

NEAREST_DEPTH_M = 0.01
"""Least distance that lerobot's codes state."""


def depth(case: Case) -> Iterator[Fault]:
    """Check that depth in videos is within half a code of the stored depth."""
    for copy in case.whole:
        for (view, step), depth_m in copy.depth_m.items():
            expected_m = np.maximum(case.sampled_depth_m[view, step], NEAREST_DEPTH_M)
            if depth_m.shape != expected_m.shape:
                yield case.finding(copy.dataset, f"{view}_depth is {depth_m.shape}", expected_m.shape)
                continue
            errors_m = np.abs(depth_m - expected_m)
            wrong = errors_m > DEPTH_SHARE * (expected_m + DEPTH_OFFSET_M)
            if wrong.any():
                what = f"{view}_depth of step {step} differs by up to {1000 * errors_m.max():.1f} mm"
                yield case.finding(copy.dataset, what, "the stored depth, within half a code")


def boxes(case: Case) -> Iterator[Fault]:
    """Compare the stored boxes with the masks of the same steps, if both are stored.

    The masks give the boxes of the gripper and of the things that the goal names.
    """
    if not case.made.instances:
        return  # Neither boxes nor masks are stored.
    places = [case.made.instances.index("gripper"), *_goal_places(case)]
    for view, made in case.made.geometry.items():
        if made.boxes is None or "segmentation" not in made.maps:
            continue
        for step in sampled(len(case.made)):
            ids = decode_exactly(made.maps["segmentation"][step])
            expected = np.zeros_like(made.boxes[step])
            for place in places:
                # OpenCV's rectangle has the first column and row, and the numbers of columns and rows.
                expected[place] = cv2.boundingRect(np.asarray(ids == place, np.uint8))
            wrong = np.flatnonzero(np.any(expected != made.boxes[step], axis=1))
            if len(wrong):
                what = f"{view}_boxes of step {step} has {made.boxes[step][wrong[0]].tolist()} at place {wrong[0]}"
                yield case.finding("frames", what, expected[wrong[0]].tolist())
                break


def _goal_places(case: Case) -> list[int]:
    """List the places in ``instances`` of the things that the task's goal names."""
    problem = definition_of(case.task)
    named_things: set[str] = set()
    for fact in problem.goal:
        named_things.update(problem.things_named(fact[1:]))
    return [place for place, name in enumerate(case.made.instances) if name in named_things]


def video(case: Case) -> Iterator[Fault]:
    """Check that frames of videos are within ``VIDEO_PSNR_DB`` and ``COLOURS_OFF`` of the stored frames."""
    for shown_view in case.shown_views:
        stored, within = case.stored[shown_view.view], f"{VIDEO_PSNR_DB} or more"
        for step, frame in shown_view.frames.items() if shown_view.video else ():
            name = f"{shown_view.view} of step {step}"
            psnr_db = cv2.PSNR(shown_view.grey[step], stored.grey[step])
            if psnr_db < VIDEO_PSNR_DB:
                yield case.finding(shown_view.dataset, f"{name} has {psnr_db:.1f} dB", within)
                continue
            difference = _colours_off(frame, stored.frames[step])
            if difference > COLOURS_OFF:
                yield case.finding(shown_view.dataset, f"{name} has other colours ({difference:.2f})", f"{COLOURS_OFF}")


def cameras(case: Case) -> Iterator[Fault]:
    """Check that no view shows the picture of another camera."""
    for shown_view in case.shown_views:
        for step, frame in shown_view.grey.items():
            for view in case.stored.keys() - {shown_view.view}:
                if cv2.PSNR(frame, case.stored[view].grey[step]) > VIDEO_PSNR_DB:
                    yield case.finding(
                        shown_view.dataset, f"{shown_view.view} of step {step} shows {view}", "its own camera"
                    )


def alive(case: Case) -> Iterator[Fault]:
    """Check that no view has a blank frame or stays constant."""
    for shown_view in case.shown_views:
        first, *_ = frames = [*shown_view.frames.values()]
        still_levels = STILL_LEVELS if shown_view.view in SCHEMA.views else FAR_STILL_LEVELS
        if min(cv2.meanStdDev(frame.reshape(-1))[1].item() for frame in frames) < BLANK_LEVELS:
            yield case.finding(
                shown_view.dataset, f"{shown_view.view} has a blank frame", f"more than {BLANK_LEVELS} grey levels"
            )
        elif max(cv2.norm(frame, first, cv2.NORM_L1) / frame.size for frame in frames) < still_levels:
            yield case.finding(
                shown_view.dataset, f"{shown_view.view} is constant", "a camera that sees the robot move"
            )


def gripper(case: Case) -> Iterator[Fault]:
    """Check that commands are -1 or +1, and that the fingers open and close accordingly."""
    commands = SCHEMA.action.gripper
    for copy in case.whole:
        command, state = copy.episode.action[:, 6], copy.episode.state
        strange = commands.others(command)
        if strange:
            yield case.finding(copy.dataset, f"gripper command {min(strange)}", f"{commands.open} or {commands.close}")
        gap_m = state[:, 6] - state[:, 7]
        moved_m = np.sign(command[:-1] * commands.open) * np.diff(gap_m)
        responding = np.zeros(len(moved_m), bool)
        for step in np.flatnonzero(np.diff(command)) + 1:
            responding[step : step + RESPONSE_STEPS] = True
        with_command_m = float(moved_m[responding].sum())
        if with_command_m < -AGAINST_M:
            what = f"fingers move {-with_command_m:.3f} m against changes of the gripper's command"
            yield case.finding(copy.dataset, what, f"{commands.open} opens, {commands.close} closes")


def flags(case: Case) -> Iterator[Fault]:
    """Check the marks of the first and last step, of success, and the reward, which only a success's last step has.

    Marks that a dataset does not have are skipped.
    """
    for copy in case.copies:
        step = np.arange(len(copy))
        last = step == len(step) - 1
        marks = {"is_first": step == 0, "is_last": last, "discount": step >= 0}
        marks |= dict.fromkeys(("is_terminal", "reward"), last & case.row["kept"])
        marks["is_success"] = np.full(len(step), case.row["kept"])
        yield from _marked(case, copy, marks)


def clock(case: Case) -> Iterator[Fault]:
    """Check that physics steps and timestamps keep the frame rate, and that frames are counted from 0.

    Timestamps and frame numbers are skipped if a dataset does not have them.
    """
    taken = np.diff(case.trajectory.states[:, 0])
    if not np.allclose(taken, 1 / SCHEMA.fps_hz, rtol=0, atol=1e-6):
        yield case.finding("frames", f"steps take {taken.min():g} to {taken.max():g} s", f"{1 / SCHEMA.fps_hz:g} s")
    for copy in case.copies:
        step = np.arange(len(copy))
        yield from _marked(case, copy, {"frame_index": step, "timestamp": step / SCHEMA.fps_hz})


def statistics(case: Case) -> Iterator[Fault]:
    """Compare each episode's statistics with its numbers, and those of its views with the stored frames."""
    for copy in case.whole:
        statistics = copy.statistics
        if statistics is None:
            continue
        stored, quantiles = statistics.stored, statistics.quantiles
        wrong: list[tuple[str, str]] = []
        if stored.keys() != statistics.numbers.keys() | {*statistics.views.values(), *statistics.depth.values()}:
            wrong.append((f"states the columns {sorted(stored)}", f"{sorted(statistics.numbers)} and the views"))
        figures = (*FIGURES, *quantiles)
        for column, values in statistics.numbers.items():
            stated = stored.get(column, {})
            lacking = [*complete(column, stated, figures, values.shape[1])]
            wrong += lacking or wrong_numbers(column, stated, values, quantiles)
        for view, column in statistics.views.items():
            stated = stored.get(column, {})
            lacking = [*complete(column, stated, figures, 3)]
            if lacking:
                wrong += lacking
                continue
            wrong += wrong_sample(column, stated, case.sampled_levels[view], len(case.made))
            if case.witness:
                wrong += wrong_pixels(column, stated, case.levels[view], quantiles)
        for view, column in statistics.depth.items():
            stated = stored.get(column, {})
            lacking = [*complete(column, stated, figures, 1)]
            sample_m = [map_m for (name, _), map_m in case.sampled_depth_m.items() if name == view]
            maps_m = case.depth_m(view) if case.witness else np.stack(sample_m)
            wrong += lacking or wrong_depth(column, stated, maps_m, len(case.made), quantiles)
        for what, expected in wrong:
            yield case.finding(copy.dataset, what, expected)


def _marked(case: Case, copy: Copy, wanted: Mapping[str, NDArray[Any]]) -> Iterator[Fault]:
    for name in sorted(copy.marks.keys() & wanted.keys()):
        values, expected = copy.marks[name], wanted[name]
        for step in np.flatnonzero(~np.isclose(values, expected, rtol=0, atol=1e-4))[:1]:
            what = f"{name} of step {step} is {float(values[step]):g}"
            yield case.finding(copy.dataset, what, f"{float(expected[step]):g}")


def _same(one: NDArray[Any] | None, other: NDArray[Any] | None) -> bool:
    """Compare two arrays bit for bit; `None` equals only `None`."""
    if one is None or other is None:
        return one is other
    return (one.shape, one.dtype, one.tobytes()) == (other.shape, other.dtype, other.tobytes())


def _listed(place: Mapping[str, Any]) -> str:
    return ", ".join(f"{column} {value}" for column, value in place.items())


Check = Callable[[Case], Iterable[Fault]]

_LABELS = (length, motion, instruction, labels, wording, provenance, results, place)
_PICTURES = (jpeg, geometry, depth, boxes, video, cameras, alive)
_EVERY = (*_LABELS, *_PICTURES, gripper, flags, clock, statistics)
CHECKS: Mapping[str, Check] = {check.__name__: check for check in _EVERY}
"""Name to check."""


def applies(check: str, case: Case) -> bool:
    """Return whether a check has anything to compare: some need content that only some runs request."""
    if check == "video":
        return any(shown_view.video for shown_view in case.shown_views)
    if check == "depth":
        return any(copy.depth_m for copy in case.whole)
    if check == "boxes":
        return any(made.boxes is not None and "segmentation" in made.maps for made in case.made.geometry.values())
    return True
