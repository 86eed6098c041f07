"""Sampling of a plan's perturbations: different ones for a demonstration, each at its clearance from all test tasks."""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import NamedTuple

from pipeline.axes import Axis, Perturbation, TextPerturbation, from_json
from pipeline.errors import PipelineError
from pipeline.libero.demonstrations import DemoEntry
from pipeline.seeding import digest, rng
from pipeline.testset.benchmark import TestSet
from pipeline.types import Task

_ATTEMPTS = 100
"""Number of samples after which no different, or no clear, perturbation counts as possible."""


class TakenEntries:
    """Counts of the list entries that the candidates of one task have taken, for axes that take entries of lists.

    A candidate takes one of the entries that the fewest earlier candidates have; its key decides between them. All
    entries are therefore used once before any is used again. An additional demonstration changes few entries of the
    other demonstrations.
    """

    def __init__(self) -> None:
        """Start without any taken entry."""
        self._times: Counter[str] = Counter()

    def order(self, entries: Sequence[str], key: str) -> list[int]:
        """Return the indices of the entries in the order in which a candidate tries them."""

        def rank(entry_index: int) -> tuple[int, str]:
            entry = entries[entry_index]
            return self._times[entry], digest(key, entry)

        return sorted(range(len(entries)), key=rank)

    def take(self, entry: str) -> None:
        """Count an entry as taken by a candidate."""
        self._times[entry] += 1


class _FirstSample(NamedTuple):
    """First sample of an axis.

    Attributes:
        task: the task that the axis perturbs, which an earlier axis may have carried to another scene.
        earlier: perturbations that the episode's start has from an expansion; none if the episode starts from a reset.
        entry_index: index into the axis's ``entries``; 0 if the axis has none.
    """

    axis: Axis
    task: Task
    earlier: Sequence[Perturbation]
    entry_index: int
    perturbation: Perturbation


@dataclass(frozen=True)
class Sampler:
    """Source of perturbations for a plan's episodes of one axis or combination.

    A *candidate* is a demonstration's id and the number of a variant. Each random choice has a key, which begins with
    ``seed`` and ``name``:

    * ``(seed, name, demo_id, variant)``: order of the list entries that a candidate tries;
    * ``(seed, name, demo_id, variant, attempt)``: first samples of all axes, from one generator;
    * ``(seed, name, demo_id, variant, attempt, n)``: further samples of axis ``n``, counted from 0.

    Attributes:
        name: name of the axis or combination, as in ``plan.episodes``.
        axes: axes to sample from.
        seed: seed of the plan.
        test: the benchmark's tasks, to which perturbations keep their clearance.
    """

    name: str
    axes: Sequence[Axis]
    seed: int
    test: TestSet

    def sample(
        self, demo_id: str, task: Task, taken: TakenEntries | None = None, expanded_by: str = "[]"
    ) -> Iterator[tuple[Perturbation, ...]]:
        """Sample for one demonstration, variant after variant: all different, and each at its clearance from all tests.

        Args:
            taken: list entries that other demonstrations of the task have taken; no entries by default.
            expanded_by: JSON of the perturbations with which an expansion generated the demonstration.

        Yields:
            One perturbation of each axis, until no different one is left.

        Raises:
            PipelineError: when another version with other perturbations generated the demonstration.
        """
        earlier = _read_earlier(demo_id, expanded_by)
        taken = taken or TakenEntries()
        contents: set[tuple[str, ...]] = set()
        for variant in count():
            sampled = self._sample_variant(task, taken, earlier, (demo_id, variant), contents)
            if sampled is None:
                return
            first_samples, perturbations = sampled
            contents.add(_content_of(perturbations))
            for first in first_samples:
                entries = first.axis.entries(first.task)
                if entries:
                    taken.take(entries[first.entry_index])
            yield perturbations

    def _sample_variant(
        self,
        task: Task,
        taken: TakenEntries,
        earlier: Sequence[Perturbation],
        candidate: tuple[str, int],
        contents: Collection[tuple[str, ...]],
    ) -> tuple[list[_FirstSample], tuple[Perturbation, ...]] | None:
        """Sample one perturbation of each axis, different from those of all earlier variants.

        Args:
            contents: contents of the earlier variants, see ``_content_of``.

        Returns:
            The first samples and the perturbations; ``None`` if no attempt gives different perturbations that are
            clear.
        """
        for attempt in range(_ATTEMPTS):
            first_samples = self._sample_first(task, taken, earlier, candidate, attempt)
            perturbations = self._keep_or_resample_all(first_samples, candidate, attempt)
            if perturbations and _content_of(perturbations) not in contents:
                return first_samples, perturbations
        return None

    def _sample_first(
        self,
        task: Task,
        taken: TakenEntries,
        earlier: Sequence[Perturbation],
        candidate: tuple[str, int],
        attempt: int,
    ) -> list[_FirstSample]:
        """Sample one perturbation of each axis, in the order in which they apply."""
        random = rng(self.seed, self.name, *candidate, attempt)
        samples: list[_FirstSample] = []
        for axis in self.axes:
            entries = axis.entries(task)
            entry_index = 0
            if entries:
                order = taken.order(entries, digest(self.seed, self.name, *candidate))
                entry_index = order[attempt % len(order)]
            perturbation = axis.sample_after(random, task, entry_index, earlier)
            samples.append(_FirstSample(axis, task, earlier, entry_index, perturbation))
            task = perturbation.carry(task)
            if perturbation.reset_seed is not None:
                earlier = ()
        return samples

    def _keep_or_resample_all(
        self, first_samples: Sequence[_FirstSample], candidate: tuple[str, int], attempt: int
    ) -> tuple[Perturbation, ...] | None:
        """Return one clear perturbation for each first sample, or ``None`` if an axis has none that is clear."""
        sampled = [first.perturbation for first in first_samples]
        instruction = " ".join(change.apply("") for change in sampled if isinstance(change, TextPerturbation))
        perturbations = []
        for number, first in enumerate(first_samples):
            key = (*candidate, attempt, number)
            clear = self._keep_or_resample(first, instruction, key)
            if clear is None:
                return None
            perturbations.append(clear)
        return tuple(perturbations)

    def _keep_or_resample(
        self, first_sample: _FirstSample, instruction: str, key: tuple[str | int, ...]
    ) -> Perturbation | None:
        """Return the first sample if it is clear, else sample a clear perturbation of its component and level.

        A clear perturbation keeps its clearance to the test set, unless the axis keeps none, and the ``instruction``
        does not name it. Component and level are kept because strengths near the test set's would otherwise become
        rare.

        Args:
            key: key of further samples, without ``seed`` and ``name``.

        Returns:
            The perturbation. ``None`` if many attempts give no clear one, or if the axis takes the entries of a list:
            the caller then tries the next entry.
        """
        axis, task, first = first_sample.axis, first_sample.task, first_sample.perturbation

        def is_clear(perturbation: Perturbation) -> bool:
            if perturbation.named_in(instruction):
                return False
            nearest = perturbation.nearest(self.test, task)
            return nearest.distance >= perturbation.clearance or not axis.keeps_clearance

        if is_clear(first):
            return first
        if axis.entries(task):
            return None
        random = rng(self.seed, self.name, *key)
        axis_at_level = axis.model_copy(update={"levels": (first.level,)})
        for _ in range(_ATTEMPTS):
            perturbation = axis_at_level.sample_after(random, task, 0, first_sample.earlier)
            is_alike = (perturbation.component, perturbation.level) == (first.component, first.level)
            if is_alike and is_clear(perturbation):
                return perturbation
        return None


def _content_of(perturbations: Sequence[Perturbation]) -> tuple[str, ...]:
    """Return the content of each perturbation as JSON; equal perturbations have equal content."""
    return tuple(perturbation.model_dump_json() for perturbation in perturbations)


def _read_earlier(demo_id: str, expanded_by: str) -> tuple[Perturbation, ...]:
    """Read the perturbations with which an expansion generated a demonstration.

    Raises:
        PipelineError: when another version with other perturbations generated it.
    """
    try:
        return tuple(from_json(expanded_by))
    except PipelineError as error:
        raise PipelineError(
            f"the perturbations of this expanded demonstration cannot be read ({error.what})",
            where=demo_id,
            expected="perturbations of this version",
            remedy="expand the human demonstrations again into another folder",
        ) from error


def sample_candidates(
    sampler: Sampler, demos: Sequence[DemoEntry]
) -> Iterator[tuple[DemoEntry, tuple[Perturbation, ...], int]]:
    """Sample a task's candidates: the first variant of every demonstration, then the second of every one, and so on.

    A demonstration without further different perturbations is skipped. The candidates end when all demonstrations are
    skipped.

    Yields:
        Demonstration, perturbations and number of the variant.
    """
    taken = TakenEntries()
    samples = {demo: sampler.sample(demo.demo_id, demo.task, taken, demo.perturbations) for demo in demos}
    for variant in count():
        for demo, samples_of_demo in [*samples.items()]:
            perturbations = next(samples_of_demo, None)
            if perturbations is None:
                del samples[demo]
            else:
                yield demo, perturbations, variant
        if not samples:
            return
