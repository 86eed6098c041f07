"""Table and plot of the results: success by axis and arm, paired differences, and reached goals by instruction."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, combinations
from pathlib import Path
from typing import Any

from instructions import at_own_place
from results import PolicyResults, join, read
from scipy.stats import binomtest

from pipeline.errors import PipelineError
from pipeline.evaluation.results import EpisodeResult, Trial
from pipeline.evaluation.statistics import Pair, compare, paired, success_rate, wilson
from pipeline.files import replaced, write
from pipeline.libero.tasks import tasks

DOCS = Path(__file__).resolve().parents[2] / "docs"
LOG = Path(__file__).resolve().parents[1] / "LOG.md"
"""Page with the tables of the further experiments."""

FURTHER = Path(__file__).with_name("further") / "results"
"""Folder with one subfolder of results for each further experiment."""

SHOWN = "axes"
"""The further experiment whose tables and plot docs/effect.md shows, because it has all axes."""

JOINED_WITH = {"starts": "no_state", "goals_many": "goals", "axes_relative": "axes"}
"""Further experiment to a second one whose arms join its table: both share policies, tests and demonstrations."""

SUMMARIZED = {
    "`released`": ("axes", "released"),
    "`all`": ("axes", "all"),
    "`ours`": ("no_state", "ours"),
    "`robots`": ("starts", "robots"),
    "`poses`": ("starts", "poses"),
    "`all`, object": ("object", "all"),
    "the same, twice the steps": ("object_long", "all"),
    "`all`, spatial": ("spatial", "all"),
}
"""Column of the summary to the further experiment and the arm that it compares with clean data."""

BEYOND_CHANCE = 0.05
"""Holm's p-value below which the summary shows a difference in bold type."""

LINES = {
    "clean": "LIBERO's own",
    "robot": "robot",
    "language": "language",
    "pose": "pose",
    "camera": "camera",
    "noise": "noise",
    "camera, noise": "camera, noise",
    "light": "light, held out",
    "background": "background, held out",
    "layout": "added objects, held out",
    "camera, held out": "camera, held out",
    "noise, held out": "noise, held out",
    "goal": "held-out goals elsewhere",
    "goal, own place": "held-out goals at their own place",
}
FIRST_STATE = ("robot", "language", "camera", "noise")
"""Axes whose test tasks of LIBERO-Plus have the objects where LIBERO's first initial state has them."""

OWN_PLACE = ", own place"
"""End of the names of lines and kinds whose thing stands in the scene where it stands in the asked task's own scene."""
KINDS = {
    "own": "the scene's own instruction",
    "carried": "another task's in the plan, elsewhere",
    "carried, own place": "another task's in the plan, at its own place",
    "held out": "another task's held out, elsewhere",
    "held out, own place": "another task's held out, at its own place",
    "nothing": "nothing",
}
COLOURS = ("#6b7d94", "#e59a00", "#1f9e82", "#9467d6")

Rows = Mapping[int, Sequence[EpisodeResult]]
"""Seed to the episodes of an arm's policy with that seed."""


def line_of(policy: PolicyResults, row: EpisodeResult) -> str:
    """Return the line of the table that a policy's result belongs to.

    Camera and noise share a line in experiments with few tests of both, those without held-out perturbations.
    """
    if row.axis in ("camera", "noise"):
        if row.source == "own":
            return f"{row.axis}, held out"
        if "held_out" not in policy.settings["evaluation"]:
            return "camera, noise"
    if row.axis != "goal":
        return row.axis
    (asked,) = (task.name for task in tasks(row.suite) if task.instruction == row.instruction)
    return row.axis + (OWN_PLACE if at_own_place(row.suite, row.base, asked) else "")


def of_line(results: Sequence[PolicyResults], line: str) -> dict[str, Rows]:
    """Select the episodes of one line of the table by arm."""
    episodes: dict[str, dict[int, list[EpisodeResult]]] = defaultdict(dict)
    for policy in results:
        episodes[policy.arm][policy.seed] = [row for row in policy.rows if line_of(policy, row) == line]
    return dict(episodes)


def lines_of(results: Sequence[PolicyResults]) -> list[str]:
    """List the lines of the table that have episodes."""
    lines_with_episodes: set[str] = set()
    for policy in results:
        lines_with_episodes |= {line_of(policy, row) for row in policy.rows}
    return [line for line in LINES if line in lines_with_episodes]


def arms_of(results: Sequence[PolicyResults]) -> list[str]:
    """List the arms in the order of the results, each once."""
    return list(dict.fromkeys(policy.arm for policy in results))


def differences(results: Sequence[PolicyResults]) -> list[dict[str, Any]]:
    """Compare each two arms on each line: ``value`` (second minus first), ``low``, ``high``, ``p_value``, ``holm``.

    Episodes are paired by seed. Test tasks are resampled within the tasks of the scene, each with all seeds.
    ``p_value`` is the larger p-value of resampling and of ``sign_flip``, as resampling is unreliable if few tests
    differ. ``holm`` is the p-value by Holm (1979) over the lines of the two arms.

    Raises:
        PipelineError: when two arms have different tests.
    """
    compared: list[dict[str, Any]] = []
    for first, second in combinations(arms_of(results), 2):
        lines: list[dict[str, Any]] = []
        for line in lines_of(results):
            episodes = of_line(results, line)
            seeds = episodes[first].keys() & episodes[second].keys()
            pairs: list[Pair] = []
            for seed in sorted(seeds):
                rows_of_first, rows_of_second = episodes[first][seed], episodes[second][seed]
                _reject_different_tests(rows_of_first, rows_of_second, f"{first} and {second}", line)
                pairs += paired(rows_of_first, rows_of_second)
            if pairs:
                measured = compare(pairs)["all"]["difference"]
                p_value = max(measured["p_value"] or 0.0, sign_flip(pairs))
                lines.append({"first": first, "second": second, "line": line, **measured, "p_value": p_value})
        adjusted = holm([difference["p_value"] for difference in lines])
        compared += [{**difference, "holm": p_value} for difference, p_value in zip(lines, adjusted, strict=True)]
    return compared


def _reject_different_tests(
    first: Sequence[EpisodeResult], second: Sequence[EpisodeResult], arms: str, line: str
) -> None:
    """Raise a ``PipelineError`` if the episodes of two arms on a line do not belong to the same tests."""
    tests_of_first, tests_of_second = {row.trial for row in first}, {row.trial for row in second}
    if tests_of_first != tests_of_second:
        raise PipelineError(
            f"{arms} have different tests on {LINES[line]}: {len(tests_of_first)} and {len(tests_of_second)}, of which "
            f"{len(tests_of_first & tests_of_second)} are equal",
            expected="equal tests in the results of all arms",
            remedy="evaluate both arms again with one configuration",
        )


def sign_flip(pairs: Sequence[Pair]) -> float:
    """Compute the exact two-sided p-value of two arms' total difference (Fisher, 1935).

    If the arms are equal, both signs of a test's difference over all its seeds are equally likely.
    """
    by_trial: Counter[Trial] = Counter()
    for first, second in pairs:
        by_trial[first.trial] += second.success - first.success
    totals = Counter({0: 1})
    for value in by_trial.values():
        flipped: Counter[int] = Counter()
        for total, ways in totals.items():
            flipped[total + value] += ways
            flipped[total - value] += ways
        totals = flipped
    least = abs(sum(by_trial.values()))
    return sum(ways for total, ways in totals.items() if abs(total) >= least) / totals.total()


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p-values: multiply the smallest by their number, the next by one less, never falling (Holm, 1979)."""
    adjusted, most = [1.0] * len(p_values), 0.0
    for rank, place in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        most = max(most, min(1.0, (len(p_values) - rank) * p_values[place]))
        adjusted[place] = most
    return adjusted


def reading(results: Sequence[PolicyResults], arm: str) -> dict[str, Counter[str | None]]:
    """Count the reached goals of each instruction, over all seeds."""
    counts: dict[str, Counter[str | None]] = defaultdict(Counter)
    for row in _readings(results, arm):
        counts[row["instruction"]][row["reached"]] += 1
    return dict(counts)


def reading_by_kind(results: Sequence[PolicyResults], arm: str) -> dict[str, Counter[str]]:
    """Count the reached goals of each kind of instruction, over all scenes and seeds.

    A reached goal is the ``asked`` one, that of the scene's own (``usual``) task, or ``another``; else ``none``.
    """
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
    (suite,) = {name.partition("/")[0] for name in results[0].settings["run"]["demos"]["tasks"]}
    for row in _readings(results, arm):
        outcomes = {None: "none", row["scene"]: "usual"}
        kind = row["kind"]
        if row["asked"]:
            outcomes[row["asked"]] = "asked"
        if f"{kind}{OWN_PLACE}" in KINDS and at_own_place(suite, row["scene"], row["asked"]):
            kind += OWN_PLACE
        counts[kind][outcomes.get(row["reached"], "another")] += 1
    return counts


def _readings(results: Sequence[PolicyResults], arm: str) -> Iterator[dict[str, Any]]:
    """Yield the episodes with instructions in LIBERO's words."""
    for policy in results:
        if policy.arm == arm:
            yield from (row for row in policy.reading if row["kind"] != "rewrite")


def markdown(results: Sequence[PolicyResults]) -> str:
    """Return all tables as Markdown."""
    text = "Success, in brackets of each seed:\n\n" + _table(_success_rows(results))
    rows = _difference_rows(results)
    if rows:
        text += "\nDifference in points, of the same episodes, with 95 % interval and Holm's p below 1:\n\n"
        text += _table(rows)
    rows = _first_state_rows(results)
    if rows:
        text += "\nSuccess on LIBERO-Plus's tests of tasks whose first state a policy solves unperturbed:\n\n"
        text += _table(rows)
    rows = _rewrite_rows(results)
    if rows:
        text += "\nSuccess with LIBERO-Plus's rewrites from several of LIBERO's initial states, and with LIBERO's "
        text += "instruction from the same states:\n\n" + _table(rows)
    readings = chain.from_iterable(_readings(results, arm) for arm in arms_of(results))
    if len({row["scene"] for row in readings}) > 1:
        text += "\nReached goals by instruction, all scenes and seeds together:\n\n"
        return text + _table(_kind_rows(results))
    text += "\nEpisodes that reach the goal of the instruction, and other reached goals by name:\n\n"
    return text + _table(_reading_rows(results))


def _success_rows(results: Sequence[PolicyResults]) -> list[list[str]]:
    """Return the success rates by line and arm, with those of black views if there are any."""
    arms = arms_of(results)
    rows = [["tests", "episodes", *arms]]
    for line in lines_of(results):
        episodes = of_line(results, line)
        of_first_policy = next(iter(episodes[arms[0]].values()))
        rows.append([LINES[line], str(len(of_first_policy)), *(_solved(episodes[arm]) for arm in arms)])
    if any(policy.black for policy in results):
        black: dict[str, list[list[bool]]] = {arm: [] for arm in arms}
        for policy in results:
            black[policy.arm].append([row["success"] for row in policy.black])
        number = max(len(trials) for trials in chain.from_iterable(black.values()))
        rows.append(["LIBERO's own, views black", str(number), *map(_rates, black.values())])
    return rows


def _first_state_rows(results: Sequence[PolicyResults]) -> list[list[str]]:
    """Return the success on tests of ``FIRST_STATE``, without tasks whose unperturbed first state no policy solves.

    An empty list if there is no such task.
    """
    rows_of_policies = chain.from_iterable(policy.rows for policy in results)
    first_states = [row for row in rows_of_policies if row.source == "libero" and row.number == 0]
    solved = {row.base for row in first_states if row.success}
    if solved == {row.base for row in first_states}:
        return []
    arms = arms_of(results)
    rows = [["tests", "episodes", *arms]]
    for axis in FIRST_STATE:
        of_arms: dict[str, list[list[bool]]] = {arm: [] for arm in arms}
        for policy in results:
            tests = [row for row in policy.rows if row.source == "libero_plus" and row.axis == axis]
            of_arms[policy.arm].append([row.success for row in tests if row.base in solved])
        episodes = max(len(trials) for trials in chain.from_iterable(of_arms.values()))
        if episodes:
            rows.append([axis, str(episodes), *map(_rates, of_arms.values())])
    return rows


def _rewrite_rows(results: Sequence[PolicyResults]) -> list[list[str]]:
    """Return the success with rewrites from several initial states by arm; an empty list without such episodes.

    ``p`` is that of McNemar's exact test of both instructions, over all seeds.
    """
    rows = [["arm", "episodes", "rewrite", "LIBERO's", "only the rewrite", "only LIBERO's", "p"]]
    for arm in arms_of(results):
        with_rewrite: list[list[bool]] = []
        with_original: list[list[bool]] = []
        for policy in results:
            if policy.arm != arm:
                continue
            solved = {(row.base, row.number): row.success for row in policy.rows if row.source == "libero"}
            rewritten = [row for row in policy.reading if row["kind"] == "rewrite"]
            with_rewrite.append([row["reached"] == row["asked"] for row in rewritten])
            with_original.append([solved[row["asked"], row["state"]] for row in rewritten])
        outcomes = Counter(zip(chain(*with_rewrite), chain(*with_original), strict=True))
        if outcomes:
            gained, lost = outcomes[True, False], outcomes[False, True]
            p_value = binomtest(gained, gained + lost).pvalue if gained + lost else 1.0
            rates = [_rates(with_rewrite), _rates(with_original)]
            rows.append([arm, str(len(with_rewrite[0])), *rates, str(gained), str(lost), f"{p_value:.2g}"])
    return rows if len(rows) > 1 else []


def _difference_rows(results: Sequence[PolicyResults]) -> list[list[str]]:
    """Return the differences by line and pair of arms; an empty list if there is no pair."""
    cells: dict[str, dict[str, str]] = defaultdict(dict)
    for row in differences(results):
        bounds = "" if row["low"] is None else f" ({100 * row['low']:+.0f} to {100 * row['high']:+.0f})"
        pair = f"{row['second']} - {row['first']}"
        cells[LINES[row["line"]]][pair] = f"{100 * row['value']:+.0f}{bounds}{_p_value(row['holm'])}"
    if not cells:
        return []
    pairs = next(iter(cells.values()))
    return [["tests", *pairs], *([line, *texts.values()] for line, texts in cells.items())]


def summary() -> str:
    """Return a table of the differences between the arms of ``SUMMARIZED`` and clean data."""
    seeds, perturbed = ["*seeds*"], ["*perturbed episodes in each scene*"]
    cells: dict[str, dict[str, str]] = defaultdict(dict)
    for column, (experiment, arm) in SUMMARIZED.items():
        results = _of_further(experiment)
        clean = [policy for policy in results if policy.arm == "clean"]
        policies = [policy for policy in results if policy.arm == arm]
        seeds.append(str(len({policy.seed for policy in policies} & {policy.seed for policy in clean})))
        episodes = policies[0].made["episodes_by_axis"]
        scenes = {row["scene"] for row in _readings(policies, arm)}
        perturbed.append(str((sum(episodes.values()) - episodes["clean"]) // len(scenes)))
        for row in differences([*clean, *policies]):
            points = f"{100 * row['value']:+.0f}"
            cells[row["line"]][column] = f"**{points}**" if row["holm"] < BEYOND_CHANCE else points
    rows = [["tests", *SUMMARIZED], seeds, perturbed]
    for line in LINES:
        if line in cells:
            rows.append([LINES[line], *(cells[line].get(column, "") for column in SUMMARIZED)])
    return _table(rows)


def _p_value(p_value: float) -> str:
    """Return the text of a p-value; of very small ones only the order, as resampling does not compute them."""
    if p_value < 0.01:
        return ", p < 0.01"
    return f", p {p_value:.2g}" if p_value < 1 else ""


def _reading_rows(results: Sequence[PolicyResults]) -> list[list[str]]:
    """Return the counts of reached goals by instruction and arm."""
    arms = arms_of(results)
    names = [name.partition("/")[2] for name in results[0].settings["run"]["demos"]["tasks"]]
    reached = {arm: reading(results, arm) for arm in arms}
    rows = [["instruction", *arms]]
    for instruction in reached[arms[0]]:
        cells = [_reached(counts[instruction], instruction, names) for counts in reached.values()]
        rows.append([instruction or "nothing", *cells])
    return rows


def _kind_rows(results: Sequence[PolicyResults]) -> list[list[str]]:
    """Return the counts of reached goals by kind of instruction, arm and outcome."""
    rows = [["instruction", "arm", "asked", "the scene's usual", "another", "none"]]
    for kind, words in KINDS.items():
        for arm in arms_of(results):
            counts = reading_by_kind(results, arm)[kind]
            asked = "-" if kind == "nothing" else str(counts["asked"])
            # The goal of the scene's own instruction is the usual one.
            usual = "-" if kind == "own" else str(counts["usual"])
            others = [f"{counts[outcome]} of {counts.total()}" for outcome in ("another", "none")]
            rows.append([words, arm, asked, usual, *others])
    return rows


def _reached(counts: Counter[str | None], instruction: str, names: Sequence[str]) -> str:
    asked = instruction.replace(" ", "_")
    asked_count = [str(counts[asked])] if asked in names else []
    other_counts = [f"{_short(task)} {counts[task]}" for task in names if counts[task] and task != asked]
    return f"{', '.join([*asked_count, *other_counts]) or 0} of {counts.total()}"


def _solved(seeds: Rows) -> str:
    successes: list[list[bool]] = []
    for rows in seeds.values():
        successes.append([row.success for row in rows])
    return _rates(successes)


def _rates(seeds: Sequence[Sequence[bool]]) -> str:
    """Return the success rate of all seeds with trials, followed by each seed's rate if there are several."""
    tried = [seed for seed in seeds if seed]
    if not tried:
        return "-"
    together, *by_seed = (f"{100 * sum(trials) / len(trials):.0f}" for trials in ([*chain(*tried)], *tried))
    return f"{together} %" + (f" ({', '.join(by_seed)})" if len(by_seed) > 1 else "")


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def _short(task: str) -> str:
    return task.replace("put_the_", "").replace("_", " ")


def plot(results: Sequence[PolicyResults], file: Path) -> None:
    """Plot success by line and arm, with Wilson's 95 % interval, and each seed as a dot."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.2), layout="constrained")
    axes = figure.add_subplot()
    arms = arms_of(results)
    for place, arm in enumerate(arms):
        for number, line in enumerate(lines_of(results)):
            seeds = of_line(results, line)[arm]
            rate = success_rate([*chain.from_iterable(seeds.values())])
            # All seeds act in the same tasks; they do not count as additional trials.
            low, high = wilson(rate["successes"] / len(seeds), rate["episodes"] / len(seeds))
            x, height = number + 0.8 * (place + 0.5) / len(arms) - 0.4, 100 * rate["rate"]
            spread = [[height - 100 * low], [100 * high - height]]
            axes.bar(x, height, 0.7 / len(arms), color=COLOURS[place], label=arm if number == 0 else None)
            axes.errorbar(x, height, spread, color="black", linewidth=0.8)
            each = [100 * success_rate(rows)["rate"] for rows in seeds.values()]
            axes.plot([x] * len(each), each, "o", color="black", markersize=2.5)
    named = [LINES[line].replace(", ", ",\n") for line in lines_of(results)]
    axes.set_xticks(range(len(named)), named, fontsize="small")
    axes.set_ylabel("success (%)")
    axes.set_ylim(0, 100)
    figure.legend(loc="outside upper center", ncols=len(arms), frameon=False)
    with mpl.rc_context({"svg.hashsalt": "effect", "svg.fonttype": "none"}), replaced(file) as temporary:
        figure.savefig(temporary, format="svg", metadata={"Date": None})


def publish(folder: Path, docs: Path = DOCS, log: Path = LOG) -> str:
    """Write the summary, and tables and plot of ``SHOWN``, into docs/effect.md, and all others into benchmarks/LOG.md.

    Args:
        folder: results of the first experiment.

    Returns:
        The tables in docs/effect.md.
    """
    shown = read(FURTHER / SHOWN)
    text = markdown(shown) + "\n![success by tests and arm](effect.svg)\n"
    plot(shown, docs / "effect.svg")
    _write(docs / "effect.md", "summary", summary())
    _write(docs / "effect.md", "table", text)
    _write(log, "experiment", markdown(read(folder)))
    # A folder may have the plan of all arms before the results of a policy.
    for further in sorted({file.parent for file in FURTHER.glob("*/*.json")}):
        if further.name != SHOWN:
            _write(log, further.name, markdown(_of_further(further.name)))
    return text


def _of_further(name: str) -> list[PolicyResults]:
    """Read the policies of a further experiment, after those of the experiment that it is joined with."""
    results = read(FURTHER / name)
    if name not in JOINED_WITH:
        return results
    return join(read(FURTHER / JOINED_WITH[name]), results, FURTHER / name)


def _write(page: Path, name: str, text: str) -> None:
    """Replace the text between two marks of a page."""
    before, _, rest = page.read_text().partition(f"<!-- {name} -->\n")
    _, end, after = rest.partition(f"<!-- end of {name} -->")
    assert end, f"{page} has no marks of {name}"
    write(page, f"{before}<!-- {name} -->\n{text}{end}{after}")
