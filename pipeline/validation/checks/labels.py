"""Checks of instructions, labels and the other columns of the manifest."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.axes import TextPerturbation, from_json, of_layer
from pipeline.axes.language import LanguagePerturbation, list_rewrites
from pipeline.episode_check import label_faults
from pipeline.episode_schema import SCHEMA, labels_of
from pipeline.formats.annotations import event_annotations, persistent_annotations
from pipeline.formats.read_back import Copy, Fault
from pipeline.libero.tasks import WITHOUT_DEBRIS, debris, exceeds_step_limit
from pipeline.run.manifest import OWN_VERSION, read_labels
from pipeline.validation.case import Case


def check_instruction(case: Case) -> Iterator[Fault]:
    """Check the instruction at every step, and lerobot's language columns."""
    for copy in case.comparable_copies:
        wrong = set(copy.instructions) - {case.row["instruction"]}
        if wrong:
            yield case.finding(copy.dataset, f"instruction {min(wrong)!r}", repr(case.row["instruction"]))
        yield from _compare_language(case, copy)


def _compare_language(case: Case, copy: Copy) -> Iterator[Fault]:
    """Check the entries of the language columns, at the first step of each column that has others."""
    expected = _list_language_entries(case, copy.train)
    for step, stored in enumerate(copy.persistent_language or ()):
        entries = [(*_read_entry(row), np.float32(row["timestamp"]), row["camera"]) for row in stored]
        if entries != expected:
            yield _describe_other_entries(case, copy, f"language column of step {step}", entries, expected)
            break
    if copy.events is None:
        return
    size_px = next(iter(case.sampled_views["image"].frames.values())).shape[0]
    traces = event_annotations(case.episode, size_px)
    for step, stored in enumerate(copy.events):
        event_entries = [(*_read_entry(row), row["camera"]) for row in stored]
        notes = [(note.role, note.style, note.text, note.camera) for note in traces if note.step == step]
        if event_entries != notes:
            yield _describe_other_entries(case, copy, f"language events of step {step}", event_entries, notes)
            break


def _list_language_entries(case: Case, train: bool) -> list[tuple[str, str, str, np.float32, None]]:
    """List the persistent entries: the manifest's wordings (in the training split only), subtasks and motions."""
    rewrites = case.episode.rewrites if train else ()
    entries: list[tuple[str, str, str, np.float32, None]] = []
    if rewrites:
        texts = dict.fromkeys([case.row["instruction"], *rewrites])
        entries += [("user", "task_aug", text, np.float32(0), None) for text in texts]
    for subtask in case.episode.subtasks:
        entries.append(("assistant", "subtask", subtask.text, np.float32(subtask.step / SCHEMA.fps_hz), None))
    for note in persistent_annotations(case.episode, train=False):
        if note.style == "motion":
            entries.append((note.role, note.style, note.text, note.time_s, None))
    return entries


def _read_entry(row: Mapping[str, Any]) -> tuple[str, str, str]:
    return row["role"], row["style"], row["content"]


def _describe_other_entries(
    case: Case, copy: Copy, place: str, entries: Sequence[Any], expected: Sequence[Any]
) -> Fault:
    strange = [entry for entry in entries if entry not in expected]
    lacking = [entry for entry in expected if entry not in entries]
    return case.finding(copy.dataset, f"{place} has {strange}", lacking)


def check_labels(case: Case) -> Iterator[Fault]:
    """Check the subtasks and rewrites of the manifest, and compare all copies with the manifest."""
    stated = read_labels(case.row)
    if stated is None:
        yield case.finding("manifest", "has no subtasks and rewrites", "lists, which may be empty")
        return
    for what, expected in label_faults(stated, len(case.episode)):
        yield case.finding("manifest", what, expected)
    for dataset, episode in (("frames", case.episode), *((copy.dataset, copy.episode) for copy in case.copies)):
        for name, stored in labels_of(episode).items():
            if stored != stated[name]:
                yield case.finding(dataset, f"{name} is {stored}", stated[name])


def check_wording(case: Case) -> Iterator[Fault]:
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


def check_provenance(case: Case) -> Iterator[Fault]:
    """Check the manifest's provenance.

    This project's version may differ, because a manifest can be newer than its dataset.
    """
    for copy in case.copies:
        for column in case.episode.provenance:
            value, expected = copy.episode.provenance.get(column), case.row[column]
            if value != expected and column != OWN_VERSION:
                yield case.finding(copy.dataset, f"{column} is {value!r}", repr(expected))
        for name, (column, value) in copy.repeated.items():
            if value != case.row[column]:
                yield case.finding(copy.dataset, f"{name} is {value!r}", f"{case.row[column]!r}, as {column}")


def check_results(case: Case) -> Iterator[Fault]:
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


def check_place(case: Case) -> Iterator[Fault]:
    """Check that each dataset stores the episode at the place that the manifest states."""
    for copy in case.copies:
        stated = {column: case.row[column] for column in copy.place}
        if stated != copy.place:
            yield case.finding(
                "manifest", _describe_place(stated), f"{_describe_place(copy.place)}, its place in the dataset"
            )


def _describe_place(place: Mapping[str, Any]) -> str:
    return ", ".join(f"{column} {value}" for column, value in place.items())
