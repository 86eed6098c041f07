"""The bank of rewrites is clean and complete, and the samples from it are keyed, distinct and balanced."""

import re
from collections import Counter
from pathlib import Path

import pytest
import yaml
from checkout import REPOSITORY
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from pipeline import seeding
from pipeline.axes.base import Level
from pipeline.axes.goal import GoalAxis
from pipeline.axes.language import LanguageAxis, LanguagePerturbation, distance, level_of, list_rewrites, load_bank
from pipeline.axes.language_lint import CLASSES, NAMED, lint, normalise
from pipeline.axes.layout import LayoutAxis
from pipeline.axes.noise import NoiseAxis
from pipeline.axes.pose import PoseAxis
from pipeline.axes.robot import RobotAxis
from pipeline.errors import PipelineError
from pipeline.libero.tasks import find_task, tasks
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet
from pipeline.types import Task

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
MIN_PER_CLASS = 10

OF_A_KIND = re.compile(
    r"\b(container|vessel|receptacle|appliance|equipment|device|holder|product|item|dishware|furniture|structure|unit"
    r"|condiment|beverage|broth|liquid|dessert|cupboard|platter|organizer|volume|source)s?\b"
)
"""Words for the kinds of things; LIBERO-Plus describes a thing by its kind with what it is made of or used for."""

TASKS = [task for suite in SUITES for task in tasks(suite)]
BOWL_ON_PLATE = find_task("libero_goal", "put_the_bowl_on_the_plate")


def sample(task: Task, variant: int, axis: LanguageAxis | None = None, seed: int = 0) -> LanguagePerturbation:
    return (axis or LanguageAxis()).sample(seeding.rng(seed, "language", task.name, variant), task, variant)


@pytest.fixture(params=TASKS, ids=lambda task: f"{task.suite}/{task.name}")
def task(request: pytest.FixtureRequest) -> Task:
    assert isinstance(request.param, Task)
    return request.param


def test_bank_holds_exactly_the_forty_tasks() -> None:
    stored = {(suite, name) for suite, tasks in load_bank().items() for name in tasks}
    assert stored == {(task.suite, task.name) for task in TASKS}
    assert len(stored) == 40


def test_bank_is_complete_and_clean(task: Task) -> None:
    classes = load_bank()[task.suite][task.name]
    assert set(classes) == set(CLASSES)
    assert all(len(texts) >= MIN_PER_CLASS for texts in classes.values())
    linted = {text: lint(text, task, component) for component, texts in classes.items() for text in texts}
    assert {text: fault for text, fault in linted.items() if fault} == {}


def test_things_are_also_called_by_their_kind(task: Task) -> None:
    described = [text for text in load_bank()[task.suite][task.name]["common_sense"] if OF_A_KIND.search(text)]
    assert len(described) > 5


@pytest.mark.parametrize("suite", SUITES)
def test_no_rewrite_is_stored_twice_in_a_suite(suite: str) -> None:
    classes = [texts for of_task in load_bank()[suite].values() for texts in of_task.values()]
    counts = Counter(normalise(text) for texts in classes for text in texts)
    assert [text for text, count in counts.items() if count > 1] == []


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "empty"),
        ("  \n", "empty"),
        ("Here are 20 variations of the instruction: put the bowl away", "preamble"),
        ("sure! here is another way to say it: put the bowl away", "preamble"),
        ("paraphrases of the command, put the bowl on a plate", "preamble"),
        ("put_the_bowl_on_the_plate", "debris"),
        ("put the second bowl, akita black bowl 2, on the plate", "debris"),
        ("kitchen scene, put the bowl on top of the plate", "debris"),
        ("Set the bowl down on the plate", "characters"),
        ("set the bowl down on the plate.", "characters"),
        ("set the bowl  down on the plate", "characters"),
        ("set the bowl down on the caf\u00e9 plate", "characters"),
        ("set the bowl down (on the plate)", "characters"),
        ("plate it", "2 words"),
        ("go " * 38 + "on", "39 words and marks"),
        ("go, " * 19 + "on", "39 words and marks"),
        ("go understandingly " * 9 + "on", "173 characters"),
        ("put the bowl, on the plate", "original"),
    ],
)
def test_lint_names_the_fault(text: str, reason: str) -> None:
    fault = lint(text, BOWL_ON_PLATE, "paraphrase")
    assert fault is not None
    assert reason in fault


@pytest.mark.parametrize(
    "text",
    [
        "let's have the bowl on the plate",
        "it's late; could you put the half-empty bowl on the plate, please",
        "is that the bowl? then onto the plate with it",
    ],
)
def test_lint_accepts_natural_sentences(text: str) -> None:
    assert lint(text, BOWL_ON_PLATE, "distraction") is None


def test_normalise_forgets_case_punctuation_and_spacing() -> None:
    assert normalise(" It's  the well-known Plate. ") == "its the well known plate"


def test_equal_keys_sample_equal_perturbations(task: Task) -> None:
    assert sample(task, 7) == sample(task, 7)


def test_no_rewrite_takes_a_requested_step_for_done() -> None:
    """Such as: with the top drawer opened, put the bowl in."""
    premise = re.compile(r"with (the|its) [a-z' -]*?\b(on(?! (the|its|a|top)\b)|open|opened|stored)\b")
    texts = [text for known in TASKS for group in load_bank()[known.suite][known.name].values() for text in group]
    assert len(texts) > 2000
    assert [text for text in texts if premise.match(text)] == []


def test_variants_are_distinct_until_the_bank_is_exhausted(task: Task) -> None:
    size = sum(len(texts) for texts in load_bank()[task.suite][task.name].values())
    texts = [sample(task, variant).text for variant in range(size)]
    assert len(set(texts)) == size


def test_an_exhausted_bank_starts_again() -> None:
    size = sum(len(texts) for texts in load_bank()[TASKS[0].suite][TASKS[0].name].values())
    assert [sample(TASKS[0], size + n) for n in range(4)] == [sample(TASKS[0], n) for n in range(4)]


def test_successive_variants_go_through_the_classes(task: Task) -> None:
    for start in range(0, MIN_PER_CLASS * len(CLASSES), len(CLASSES)):
        assert {sample(task, start + i).component for i in range(len(CLASSES))} == set(CLASSES)


def test_every_class_comes_first_for_some_task() -> None:
    assert {sample(task, 0).component for task in TASKS} == set(CLASSES)


def test_only_configured_classes_are_sampled(task: Task) -> None:
    axis = LanguageAxis(components=("paraphrase", "common_sense"))
    assert {sample(task, variant, axis).component for variant in range(8)} == {"paraphrase", "common_sense"}


def test_text_is_sampled_from_the_class_it_names(task: Task) -> None:
    for variant in range(8):
        perturbation = sample(task, variant)
        assert perturbation.text in load_bank()[task.suite][task.name][perturbation.component]
        assert perturbation.apply(task.instruction) == perturbation.text


def test_perturbation_survives_json() -> None:
    perturbation = sample(TASKS[0], 0)
    assert LanguagePerturbation.model_validate_json(perturbation.model_dump_json()) == perturbation


def test_unknown_task_is_named_with_the_file_and_a_remedy() -> None:
    juggle = Task("libero_goal", "juggle", "juggle", Path("juggle.bddl"))
    with pytest.raises(PipelineError, match=r"language_bank\.yaml.*libero_goal/juggle(?s:.*)try: add rewrites"):
        sample(juggle, 0)


def test_levels_and_classes_without_a_rewrite_are_named_not_the_bank() -> None:
    """23 of 40 tasks have no rewrite of this class and level, but each has others."""
    axis = LanguageAxis(components=("reasoning_chain",), levels=(1,))
    without = [task for task in TASKS if not axis.list_clear_rewrites(task, TestSet(()))]
    assert len(without) == 23
    levels = r"(?s:.*)reasoning_chain at [2-5][2-5, ]*(?s:.*)add levels or components"
    expected = rf"plan\.axes\.language: .* of class reasoning_chain at level 1{levels}"
    for task in without:
        with pytest.raises(PipelineError, match=expected):
            axis.entries(task)


def test_a_rewrite_equal_to_the_instruction_is_rejected() -> None:
    known = TASKS[0]
    wording = sample(known, 0).text
    with pytest.raises(PipelineError, match="equal to the original"):
        sample(Task(known.suite, known.name, wording, known.bddl_file), 0)


def test_an_axis_without_classes_is_rejected() -> None:
    with pytest.raises(ValidationError):
        LanguageAxis(components=())
    former = LanguageAxis.model_validate({"classes": ["paraphrase"]})
    assert former == LanguageAxis(components=("paraphrase",))


def test_among_more_objects_things_are_called_by_their_names() -> None:
    few_levels = LanguageAxis(levels=(1, 2))
    for changing in (LayoutAxis(), GoalAxis()):
        assert few_levels.restrict_for([changing, few_levels]) == LanguageAxis(levels=(1, 2), components=NAMED)
    two = LanguageAxis(components=("paraphrase", "common_sense"))
    assert two.restrict_for([LayoutAxis()]).components == ("paraphrase",)
    assert two.restrict_for([NoiseAxis(), RobotAxis(), PoseAxis()]) == two
    with pytest.raises(ValueError, match=r"with goal and layout, .* distraction or paraphrase"):
        LanguageAxis(components=("common_sense", "reasoning_chain")).restrict_for([GoalAxis(), LayoutAxis()])


def test_levels_follow_the_distance_to_the_original(task: Task) -> None:
    cards = list_rewrites(task)
    by_level = sorted(cards, key=lambda card: distance(card.text, task.instruction))
    assert [card.level for card in by_level] == sorted(card.level for card in cards)
    assert {card.text for card in cards if card.level == 1} == {
        card.text for card in cards if distance(card.text, task.instruction) < 0.5
    }


def test_only_the_levels_asked_for_are_sampled() -> None:
    levels: tuple[Level, ...] = (1, 5)
    axis = LanguageAxis(levels=levels)
    for known in TASKS[::7]:
        rewrites = [sample(known, variant, axis) for variant in range(60)]
        assert {card.level for card in rewrites} <= set(levels)
        assert {card.text for card in rewrites} == {card.text for card in list_rewrites(known) if card.level in levels}
    assert {card.level for known in TASKS for card in list_rewrites(known)} == {1, 2, 3, 4, 5}


def slow_edits(one: str, two: str) -> int:
    """Levenshtein distance by its definition."""
    if not one or not two:
        return len(one) + len(two)
    changed = slow_edits(one[:-1], two[:-1]) + (one[-1] != two[-1])
    return min(changed, slow_edits(one[:-1], two) + 1, slow_edits(one, two[:-1]) + 1)


@given(st.text("abc", max_size=5), st.text("abc", max_size=5))
def test_distance_is_the_normalised_edit_distance(one: str, two: str) -> None:
    assert distance(one, two) == slow_edits(one, two) / max(len(one), len(two), 1)


def test_distance_forgets_case_and_punctuation() -> None:
    assert distance("Put the bowl, please!", "put the bowl please") == 0
    assert distance("put the bowl", "put the bowls") == pytest.approx(1 / 13)
    assert level_of("put the bowl", "put the bowls") == 1
    assert level_of("would you be so kind as to see to the supper things", "put the bowl on it") == 5


@pytest.mark.parametrize(("edits", "level"), [(50, 2), (60, 3), (67, 4), (72, 5)])
def test_levels_begin_at_their_share_of_edited_characters(edits: int, level: Level) -> None:
    original = 100 * "a"
    assert level_of(edits * "b" + (100 - edits) * "a", original) == level
    assert level_of((edits - 1) * "b" + (101 - edits) * "a", original) == level - 1


@pytest.fixture(scope="module")
def test() -> TestSet:
    return benchmark.load(REPOSITORY / benchmark.FOLDER)


def test_the_bank_is_clear_of_the_test_set(task: Task, test: TestSet) -> None:
    tested = [str(other.parameters["text"]) for other in test.on(task, "language")]
    assert 10 < len(tested) <= 50
    close = []
    for card in list_rewrites(task):
        nearest = card.nearest(test, task)
        assert nearest.compared == len(tested)
        if nearest.distance < card.clearance:
            close.append((card.text, nearest.distance))
    assert close == []


COMMON = "the a in on of it and to into onto inside please put place that is from"
FUNCTION_WORDS = """
the a an in on of it and to into onto inside is are be that which for with you could can would please i me my so then at
by as
"""


def test_no_rewrite_shares_a_phrase_or_all_content_words_with_a_test_instruction(task: Task, test: TestSet) -> None:
    """Six consecutive words, of which two are new: neither common nor in LIBERO's instruction of the task."""
    known = {*COMMON.split(), *normalise(task.instruction).split()}
    tested = [normalise(str(other.parameters["text"])).split() for other in test.on(task, "language")]
    tested_phrases = {" ".join(words[k : k + 6]) for words in tested for k in range(len(words) - 5)}
    tested_contents = {frozenset(words) - {*FUNCTION_WORDS.split()} for words in tested}
    copied = []
    for texts in load_bank()[task.suite][task.name].values():
        for text in texts:
            words = normalise(text).split()
            shared = {" ".join(words[k : k + 6]) for k in range(len(words) - 5)} & tested_phrases
            copied += [(text, phrase) for phrase in shared if len({*phrase.split()} - known) >= 2]
            if frozenset(words) - {*FUNCTION_WORDS.split()} in tested_contents:
                copied.append((text, "all content words"))
    assert copied == []


def test_a_rewrite_that_copies_a_test_instruction_is_left_out(tmp_path: Path, test: TestSet) -> None:
    known, bank = find_task("libero_goal", "turn_on_the_stove"), tmp_path / "bank.yaml"
    text = max((str(tested.parameters["text"]) for tested in test.on(known, "language")), key=len)
    talk = "the neighbours have painted their garden fence in the brightest green that you can imagine; "
    copy = LanguagePerturbation(component="distraction", level=1, text=talk + text)
    assert min(copy.distances_on(test, known)) > copy.clearance
    assert copy.nearest(test, known).distance == 0
    reordered = copy.model_copy(update={"text": f"please {' '.join(reversed(text.split()))}"})
    assert min(reordered.distances_on(test, known)) > reordered.clearance
    assert reordered.nearest(test, known).distance == 0
    bank.write_text(yaml.safe_dump({known.suite: {known.name: {"distraction": [copy.text]}}}))
    assert copy.text in {card.text for card in list_rewrites(known, bank=bank)}
    assert {*LanguageAxis(bank=bank).list_clear_rewrites(known, test)} == {
        *LanguageAxis().list_clear_rewrites(known, test)
    }


def test_a_test_instruction_is_found_whatever_its_case_and_whatever_its_task(test: TestSet) -> None:
    """One that is nearly the same is found for tasks with the instruction of its own task only."""
    known, other = TASKS[0], TASKS[15]
    text = str(test.on(known, "language")[0].parameters["text"])
    planted = LanguagePerturbation(component="paraphrase", level=1, text=text.upper() + "!")
    assert planted.nearest(test, known).distance == 0
    assert planted.nearest(test, other).distance == 0
    no_test_of_its_own = find_task("libero_90", "KITCHEN_SCENE6_close_the_microwave")
    assert planted.nearest(test, no_test_of_its_own) == (0, 0)
    nearly = planted.model_copy(update={"text": text + "s"})
    assert nearly.nearest(test, known).distance < planted.clearance < nearly.nearest(test, other).distance
    stove, same_wording = (
        find_task(*name.split("/"))
        for name in ("libero_goal/turn_on_the_stove", "libero_90/KITCHEN_SCENE3_turn_on_the_stove")
    )
    text = str(test.on(stove, "language")[0].parameters["text"])
    nearly = planted.model_copy(update={"text": f"{text} now"})
    assert nearly.nearest(test, same_wording) == nearly.nearest(test, stove)
    assert nearly.nearest(test, same_wording).distance < planted.clearance


def test_a_further_bank_joins_the_shipped_one(tmp_path: Path) -> None:
    known = TASKS[0]
    bank = tmp_path / "bank.yaml"
    further = f"kindly {known.instruction}"
    bank.write_text(yaml.safe_dump({known.suite: {known.name: {"paraphrase": [further]}}}))
    texts = {card.text for card in list_rewrites(known, CLASSES, bank=bank)}
    assert texts - {card.text for card in list_rewrites(known)} == {further}
    with pytest.raises(PipelineError, match=r"missing\.yaml"):
        list_rewrites(known, CLASSES, bank=tmp_path / "missing.yaml")


def test_wordings_are_a_tasks_own_without_the_benchmarks(tmp_path: Path, test: TestSet) -> None:
    for known in TASKS:
        listed = {text for texts in load_bank()[known.suite][known.name].values() for text in texts}
        assert set(LanguageAxis().list_clear_rewrites(known, test)) == listed
        named = {text for one in NAMED for text in load_bank()[known.suite][known.name][one]}
        assert set(LanguageAxis().list_clear_rewrites(known, test, other_objects=True)) == named
    known, bank = TASKS[0], tmp_path / "bank.yaml"
    texts = [str(tested.parameters["text"]) for tested in test.on(known, "language")]
    tested = next(text for text in texts if lint(text, known, "distraction") is None)
    bank.write_text(yaml.safe_dump({known.suite: {known.name: {"distraction": [tested]}}}))
    assert tested in {card.text for card in list_rewrites(known, bank=bank)}
    assert {*LanguageAxis(bank=bank).list_clear_rewrites(known, test)} == {
        *LanguageAxis().list_clear_rewrites(known, test)
    }


def test_a_task_without_rewrites_has_no_wordings(test: TestSet) -> None:
    known = find_task("libero_90", "KITCHEN_SCENE6_close_the_microwave")
    assert LanguageAxis().list_clear_rewrites(known, test) == ()


def test_of_a_wording_in_both_banks_and_two_classes_the_first_counts(tmp_path: Path) -> None:
    known, bank = TASKS[0], tmp_path / "bank.yaml"
    shipped = load_bank()[known.suite][known.name]["paraphrase"]
    again = [text.replace(",", "") for text in shipped]
    new = f"kindly {known.instruction}"
    further = {"distraction": [*again, new], "paraphrase": [*shipped, new.replace("kindly", "kindly,")]}
    bank.write_text(yaml.safe_dump({known.suite: {known.name: further}}))
    rewrites = {(card.component, card.text) for card in list_rewrites(known, bank=bank)}
    assert rewrites - {(card.component, card.text) for card in list_rewrites(known)} == {("distraction", new)}
    assert len(list_rewrites(known, bank=bank)) == len(list_rewrites(known)) + 1


def test_a_bank_with_a_task_given_twice_is_rejected(tmp_path: Path) -> None:
    bank = tmp_path / "bank.yaml"
    bank.write_text("libero_goal:\n  stove: {paraphrase: []}\n  stove: {distraction: []}\n")
    with pytest.raises(PipelineError, match="the key 'stove' is repeated"):
        load_bank(bank)


def test_a_further_bank_has_to_keep_the_goal(tmp_path: Path) -> None:
    bank = tmp_path / "bank.yaml"
    text = "kindly put the bowl next to the plate"
    bank.write_text(yaml.safe_dump({BOWL_ON_PLATE.suite: {BOWL_ON_PLATE.name: {"paraphrase": [text]}}}))
    with pytest.raises(PipelineError, match=r"relation 'on' to the plate(?s:.*)language_words\.yaml"):
        list_rewrites(BOWL_ON_PLATE, CLASSES, bank=bank)
