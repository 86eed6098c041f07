"""What must hold of an episode wherever it lies: small functions, each with a name, that yield what is off."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.axes import TextPerturbation, from_json, of_layer
from pipeline.axes.language import LanguagePerturbation, deal
from pipeline.episode_schema import MATRICES, MOTION, SCHEMA
from pipeline.formats.lerobot_statistics import FIGURES, complete, wrong_numbers, wrong_pixels, wrong_sample
from pipeline.formats.read_back import Copy, Fault
from pipeline.libero.tasks import WITHOUT_DEBRIS, debris, find_task
from pipeline.run.manifest import OWN_VERSION
from pipeline.types import Frame
from pipeline.validation.case import Case

VIDEO_PSNR_DB = 32.0
"""Least PSNR, in grey, of a video's frame to the stored JPEG; panning over 30 procedural data maps it is 37.0 or more.

In colour it can be 20: a video holds colours at half the resolution, which a fine, colourful surface shows."""

COLOURS_OFF = 0.5
"""Share of a stored frame's colourfulness by which a video's colours may differ; of 3,843 frames the most was 0.14.
Grey frames are off by 1, and those with red and blue exchanged by more."""

PALE_LEVELS = 4.0
"""Frames count as at least so colourful: the mean distance of Cb and Cr from grey, in levels, over 16 by 16 fields."""

STILL_LEVELS = 0.5
"""Mean difference in grey levels up to which two frames count as the same; the least of 49 episodes was 1.4."""

BLANK_LEVELS = 5.0
"""Standard deviation in grey levels below which a frame shows nothing; the least was 27, in fog."""

AGAINST_M = 0.03
"""How far the fingers may move, in sum, against the command: pressed on the stove's knob, they moved 0.015 m; the other
way round, 49 episodes moved 0.05 m and more with it."""


def _colours_off(one: Frame, stored: Frame) -> float:
    """The mean distance of Cb and Cr over 16 by 16 fields, as a share of the stored frame's from grey."""
    fields = (
        cv2.cvtColor(cv2.resize(frame, (16, 16), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2YCrCb)[..., 1:]
        for frame in (one, stored)
    )
    found, wanted = (field.astype(float) - 128 for field in fields)
    return float(np.abs(found - wanted).mean() / max(np.abs(wanted).mean(), PALE_LEVELS))


def length(case: Case) -> Iterator[Fault]:
    """As many steps in every place as the replay executed."""
    steps = len(case.trajectory.actions)
    places = [("manifest", case.row["steps"]), ("frames", len(case.made))]
    for dataset, found in [*places, *((copy.dataset, len(copy)) for copy in case.copies)]:
        if found != steps:
            yield case.finding(dataset, f"has {found} steps", steps)


ARM = slice(1, 8)
"""Of a flattened state, after the time: LIBERO's robot comes first in every scene."""


def motion(case: Case) -> Iterator[Fault]:
    """Actions, states and joint angles, bit for bit; actions and joint angles are those of the replay."""
    replay = case.trajectory
    if not _same(case.made.joint_state, replay.states[:-1, ARM].astype(np.float32)):
        yield case.finding("frames", "has other joint angles", "those of the replay")
    if not _same(case.made.action, replay.actions.astype(np.float32)):
        yield case.finding("frames", "has other actions", "those that the replay executed")
    for copy in case.copies:
        # Of another length, nothing can be compared.
        for name in MOTION if len(copy) == len(case.made) else ():
            found, made = getattr(copy.episode, name), getattr(case.made, name)
            if (found.shape, found.dtype) != (made.shape, made.dtype):
                what, expected = f"{found.shape} of {found.dtype}", f"{made.shape} of {made.dtype}"
                yield case.finding(copy.dataset, f"{name} is {what}", expected)
            elif not _same(found, made):
                step = next(t for t in range(len(made)) if not _same(found[t], made[t]))
                what = f"{name} of step {step} is {found[step].tolist()}"
                yield case.finding(copy.dataset, what, made[step].tolist())


def instruction(case: Case) -> Iterator[Fault]:
    """The manifest's instruction at every step, and in a language column, the episode's rewrites and subtasks."""
    for copy in case.whole:
        if wrong := set(copy.instructions) - {case.row["instruction"]}:
            yield case.finding(copy.dataset, f"instruction {min(wrong)!r}", repr(case.row["instruction"]))
        expected = _said(case, copy.train)
        for step, entries in enumerate(copy.said or ()):
            said = [(one["role"], one["style"], one["content"], np.float32(one["timestamp"])) for one in entries]
            if said != expected:
                strange = [one for one in said if one not in expected]
                lacking = [one for one in expected if one not in said]
                yield case.finding(copy.dataset, f"language column of step {step} has {strange}", lacking)
                break


def _said(case: Case, train: bool) -> list[tuple[str, str, str, np.float32]]:
    """What lerobot's language column says: the rewrites, of what is trained on alone, and the subtasks."""
    rewrites = case.made.rewrites if train else ()
    texts = dict.fromkeys([case.row["instruction"], *rewrites]) if rewrites else ()
    begun = [("assistant", "subtask", one.text, np.float32(one.step / SCHEMA.fps_hz)) for one in case.made.subtasks]
    return [*(("user", "task_aug", text, np.float32(0)) for text in texts), *begun]


def wording(case: Case) -> Iterator[Fault]:
    """The task's own instruction or the rewrite of the bank that was drawn, and nothing of a file's name in it."""
    task, text = find_task(case.row["suite"], case.row["task"]), case.row["instruction"]
    expected = task.instruction
    for drawn in of_layer(from_json(case.row["perturbations"]), TextPerturbation):
        expected = drawn.apply(expected)
        if isinstance(drawn, LanguagePerturbation) and drawn not in deal(task, bank=case.bank):
            yield case.finding("manifest", f"rewrite {drawn.text!r} is not in the bank", f"one for {task.name}")
    if text != expected:
        yield case.finding("manifest", f"instruction {text!r}", repr(expected))
    if found := debris(text):
        yield case.finding("manifest", f"instruction {text!r} has {found!r}", WITHOUT_DEBRIS)


def provenance(case: Case) -> Iterator[Fault]:
    """The manifest's provenance, but for this project's version: a manifest is made anew where a dataset stays."""
    for copy in case.copies:
        for column in case.made.provenance:
            found, expected = copy.episode.provenance.get(column), case.row[column]
            if found != expected and column != OWN_VERSION:
                yield case.finding(copy.dataset, f"{column} is {found!r}", repr(expected))


def place(case: Case) -> Iterator[Fault]:
    """Where the manifest says."""
    for copy in case.copies:
        told = {column: case.row[column] for column in copy.place}
        if told != copy.place:
            yield case.finding("manifest", _listed(told), f"{_listed(copy.place)}, where it lies")


def jpeg(case: Case) -> Iterator[Fault]:
    """The very bytes of every stored frame, where a dataset has image files."""
    for copy in case.copies:
        for view, files in copy.episode.frames.items():
            pairs = zip(files, case.made.frames[view], strict=False)
            if wrong := [step for step, (one, other) in enumerate(pairs) if one != other]:
                what = f"{view} differs at {len(wrong)} steps, first at {wrong[0]}"
                yield case.finding(copy.dataset, what, "the stored JPEG")


def geometry(case: Case) -> Iterator[Fault]:
    """The matrices of the stored cameras, bit for bit, and of the extras the very files and numbers."""
    for copy in case.whole:
        for view, made in case.made.geometry.items():
            for name in MATRICES:
                found, expected = getattr(copy.episode.geometry[view], name), getattr(made, name)
                if found.dtype != expected.dtype or not np.array_equal(found, expected):
                    yield case.finding(copy.dataset, f"{view}_{name} is {found.tolist()}", expected.tolist())
            for name, files in made.maps.items():
                if list(copy.episode.geometry[view].maps[name]) != list(files):
                    yield case.finding(copy.dataset, f"{view}_{name} differs", "the stored PNG files")
        if not _same(copy.episode.object_poses, case.made.object_poses):
            yield case.finding(copy.dataset, "object_poses differ", "the stored ones")
        if list(copy.episode.instances) != list(case.made.instances):
            yield case.finding(copy.dataset, f"instances {list(copy.episode.instances)}", list(case.made.instances))


def video(case: Case) -> Iterator[Fault]:
    """Frames within ``VIDEO_PSNR_DB`` and ``COLOURS_OFF`` of the stored ones, where a dataset has no image files."""
    for seen in case.seen:
        stored, within = case.stored[seen.view], f"{VIDEO_PSNR_DB} or more"
        for step, frame in seen.frames.items() if seen.video else ():
            name = f"{seen.view} of step {step}"
            if (reached := cv2.PSNR(seen.grey[step], stored.grey[step])) < VIDEO_PSNR_DB:
                yield case.finding(seen.dataset, f"{name} has {reached:.1f} dB", within)
            elif (off := _colours_off(frame, stored.frames[step])) > COLOURS_OFF:
                yield case.finding(seen.dataset, f"{name} has other colours ({off:.2f})", f"{COLOURS_OFF}")


def cameras(case: Case) -> Iterator[Fault]:
    """No view that shows what another camera saw."""
    for seen in case.seen:
        for step, frame in seen.grey.items():
            for other in case.stored.keys() - {seen.view}:
                if cv2.PSNR(frame, case.stored[other].grey[step]) > VIDEO_PSNR_DB:
                    yield case.finding(seen.dataset, f"{seen.view} of step {step} shows {other}", "its own camera")


def alive(case: Case) -> Iterator[Fault]:
    """No view that shows nothing, or the same all along."""
    for seen in case.seen:
        first, *_ = frames = [*seen.frames.values()]
        if min(cv2.meanStdDev(frame.reshape(-1))[1].item() for frame in frames) < BLANK_LEVELS:
            yield case.finding(seen.dataset, f"{seen.view} has a blank frame", f"more than {BLANK_LEVELS} grey levels")
        elif max(cv2.norm(frame, first, cv2.NORM_L1) / frame.size for frame in frames) < STILL_LEVELS:
            yield case.finding(seen.dataset, f"{seen.view} is constant", "a camera that sees the robot move")


def gripper(case: Case) -> Iterator[Fault]:
    """Commands of -1 and +1, and fingers that part on the one and close on the other."""
    told = SCHEMA.action.gripper
    for copy in case.whole:
        command, state = copy.episode.action[:, 6], copy.episode.state
        if other := told.others(command):
            yield case.finding(copy.dataset, f"gripper command {min(other)}", f"{told.open} or {told.close}")
        gap = state[:, 6] - state[:, 7]
        opened = float((np.sign(command[:-1] * told.open) * np.diff(gap)).sum())
        if opened < -AGAINST_M:
            what = f"fingers move {-opened:.3f} m against the gripper's command"
            yield case.finding(copy.dataset, what, f"{told.open} opens, {told.close} closes")


def flags(case: Case) -> Iterator[Fault]:
    """Where a dataset has such marks: the first and the last step, and a reward for the last of a success alone."""
    for copy in case.copies:
        step = np.arange(len(copy))
        last = step == len(step) - 1
        marks = {"is_first": step == 0, "is_last": last, "discount": step >= 0}
        marks |= dict.fromkeys(("is_terminal", "reward"), last & case.row["kept"])
        yield from _marked(case, copy, marks)


def clock(case: Case) -> Iterator[Fault]:
    """Steps at the frame rate: of the physics, and counted from 0 and timed where a dataset has such marks."""
    taken = np.diff(case.trajectory.states[:, 0])
    if not np.allclose(taken, 1 / SCHEMA.fps_hz, rtol=0, atol=1e-6):
        yield case.finding("frames", f"steps take {taken.min():g} to {taken.max():g} s", f"{1 / SCHEMA.fps_hz:g} s")
    for copy in case.copies:
        step = np.arange(len(copy))
        yield from _marked(case, copy, {"frame_index": step, "timestamp": step / SCHEMA.fps_hz})


def statistics(case: Case) -> Iterator[Fault]:
    """Statistics of each episode: of its numbers, computed again, and of its frames, by the stored frames."""
    for copy in case.whole:
        if (found := copy.statistics) is None:
            continue
        wrong: list[tuple[str, str]] = []
        if found.stored.keys() != found.numbers.keys() | {*found.views.values()}:
            wrong.append((f"states the columns {sorted(found.stored)}", f"{sorted(found.numbers)} and the views"))
        figures = (*FIGURES, *found.quantiles)
        for column, values in found.numbers.items():
            stated = found.stored.get(column, {})
            lacking = [*complete(column, stated, figures, values.shape[1])]
            wrong += lacking or wrong_numbers(column, stated, values, found.quantiles)
        for view, column in found.views.items():
            stated = found.stored.get(column, {})
            if lacking := [*complete(column, stated, figures, 3)]:
                wrong += lacking
                continue
            wrong += wrong_sample(column, stated, case.sampled_levels[view], len(case.made))
            if case.witness:
                wrong += wrong_pixels(column, stated, case.levels[view], found.quantiles)
        for what, expected in wrong:
            yield case.finding(copy.dataset, what, expected)


def _marked(case: Case, copy: Copy, wanted: Mapping[str, NDArray[Any]]) -> Iterator[Fault]:
    for name in sorted(copy.marks.keys() & wanted.keys()):
        values, expected = copy.marks[name], wanted[name]
        for step in np.flatnonzero(~np.isclose(values, expected, rtol=0, atol=1e-4))[:1]:
            what = f"{name} of step {step} is {float(values[step]):g}"
            yield case.finding(copy.dataset, what, f"{float(expected[step]):g}")


def _same(one: NDArray[Any] | None, other: NDArray[Any] | None) -> bool:
    """Bit for bit; None is the same as None alone."""
    if one is None or other is None:
        return one is other
    return (one.shape, one.dtype, one.tobytes()) == (other.shape, other.dtype, other.tobytes())


def _listed(place: Mapping[str, Any]) -> str:
    return ", ".join(f"{column} {value}" for column, value in place.items())


Check = Callable[[Case], Iterable[Fault]]

_EVERY = (length, motion, instruction, wording, provenance, place, jpeg, geometry, video, cameras, alive, gripper)
CHECKS: Mapping[str, Check] = {check.__name__: check for check in (*_EVERY, flags, clock, statistics)}
"""Name to check."""
