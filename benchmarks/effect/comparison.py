"""Table and plot of the results: success by axis and arm, paired differences, and which goals instructions reach."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from itertools import chain, combinations
from pathlib import Path
from typing import Any

from results import PolicyResults, read

from pipeline.evaluation.results import EpisodeResult, Trial
from pipeline.evaluation.statistics import Pair, compare, paired, success_rate, wilson
from pipeline.files import replaced, write

DOCS = Path(__file__).resolve().parents[2] / "docs"
FURTHER = Path(__file__).with_name("further") / "results"
"""A folder of results for each further experiment."""

BESIDE = {"starts": "no_state"}
"""A further experiment to the one whose arms stand beside its own: the same policies, tests and demonstrations."""

LINES = {"clean": "LIBERO's own", "robot": "robot", "language": "language", "pose": "pose", "camera": "camera, noise"}
LINE_OF = {axis: axis for axis in LINES} | {"noise": "camera"}
COLOURS = ("#6b7d94", "#e59a00", "#1f9e82", "#9467d6")

Rows = Mapping[int, Sequence[EpisodeResult]]
"""Seed to the episodes of an arm's policy."""


def of_line(results: Sequence[PolicyResults], line: str) -> dict[str, Rows]:
    """Arm to its episodes of one line of the table."""
    found: dict[str, dict[int, list[EpisodeResult]]] = defaultdict(dict)
    for one in results:
        found[one.arm][one.seed] = [row for row in one.rows if LINE_OF[row.axis] == line]
    return dict(found)


def lines_of(results: Sequence[PolicyResults]) -> list[str]:
    """The lines that there are episodes of."""
    there = {LINE_OF[row.axis] for one in results for row in one.rows}
    return [line for line in LINES if line in there]


def differences(results: Sequence[PolicyResults]) -> list[dict[str, Any]]:
    """Each two arms on each line: ``value`` (second minus first), ``low``, ``high``, ``p_value``, and ``holm``.

    Episodes are paired by seed, test tasks are drawn anew within the tasks of the scene, each with all seeds.
    ``p_value`` is the larger of that and of ``sign_flip``: where few tests differ, resampling says too little. ``holm``
    is the p-value by Holm (1979) over the lines of the two arms.
    """
    arms = list(dict.fromkeys(one.arm for one in results))
    found = []
    for first, second in combinations(arms, 2):
        lines = []
        for line in lines_of(results):
            of = of_line(results, line)
            seeds = of[first].keys() & of[second].keys()
            pairs = [pair for seed in sorted(seeds) for pair in paired(of[first][seed], of[second][seed])]
            if pairs:
                measured = compare(pairs)["all"]["difference"]
                p_value = max(measured["p_value"] or 0.0, sign_flip(pairs))
                lines.append({"first": first, "second": second, "line": line, **measured, "p_value": p_value})
        adjusted = holm([one["p_value"] for one in lines])
        found += [{**one, "holm": p_value} for one, p_value in zip(lines, adjusted, strict=True)]
    return found


def sign_flip(pairs: Sequence[Pair]) -> float:
    """The exact two-sided p-value of two arms' total difference (Fisher, 1935).

    Where the arms are equal, each test's difference, of all its seeds together, has either sign as likely.
    """
    by_trial: Counter[Trial] = Counter()
    for one, other in pairs:
        by_trial[one.trial] += other.success - one.success
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
    """Adjusted p-values: the smallest times their number, the next times one less, never falling (Holm, 1979)."""
    adjusted, most = [1.0] * len(p_values), 0.0
    for rank, place in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        most = max(most, min(1.0, (len(p_values) - rank) * p_values[place]))
        adjusted[place] = most
    return adjusted


def reading(results: Sequence[PolicyResults], arm: str) -> dict[str, Counter[str | None]]:
    """Instruction to how often each goal was reached, all seeds together."""
    counts: dict[str, Counter[str | None]] = defaultdict(Counter)
    for row in chain.from_iterable(one.reading for one in results if one.arm == arm):
        counts[row["instruction"]][row["reached"]] += 1
    return dict(counts)


def markdown(results: Sequence[PolicyResults]) -> str:
    """All tables."""
    arms = list(dict.fromkeys(one.arm for one in results))
    rows = [["tests", "episodes", *arms]]
    for line in lines_of(results):
        of = of_line(results, line)
        rows.append([LINES[line], str(len(next(iter(of[arms[0]].values())))), *(_solved(of[arm]) for arm in arms)])
    if any(one.black for one in results):
        black = [[[row["success"] for row in one.black] for one in results if one.arm == arm] for arm in arms]
        number = max(len(seed) for seeds in black for seed in seeds)
        rows.append(["LIBERO's own, views black", str(number), *map(_rates, black)])
    text = "Success, in brackets of each seed:\n\n" + _table(rows)
    cells: dict[str, dict[str, str]] = defaultdict(dict)
    for one in differences(results):
        bounds = "" if one["low"] is None else f" ({100 * one['low']:+.0f} to {100 * one['high']:+.0f})"
        pair = f"{one['second']} - {one['first']}"
        p_value = f", p {one['holm']:.2g}" if one["holm"] < 1 else ""
        cells[LINES[one["line"]]][pair] = f"{100 * one['value']:+.0f}{bounds}{p_value}"
    if cells:
        rows = [["tests", *next(iter(cells.values()))], *([line, *of.values()] for line, of in cells.items())]
        text += "\nDifference in points, of the same episodes, with 95 % interval and Holm's p below 1:\n\n"
        text += _table(rows)
    tasks = [name.partition("/")[2] for name in results[0].settings["run"]["demos"]["tasks"]]
    reached = {arm: reading(results, arm) for arm in arms}
    rows = [["told", *arms]]
    for told in reached[arms[0]]:
        rows.append([told or "nothing", *(_reached(counts[told], told, tasks) for counts in reached.values())])
    return text + "\nHow often its goal is reached, and others by name, by what the policy is told:\n\n" + _table(rows)


def _reached(counts: Counter[str | None], told: str, tasks: Sequence[str]) -> str:
    asked = told.replace(" ", "_")
    others = [f"{_short(task)} {counts[task]}" for task in tasks if counts[task] and task != asked]
    own = [str(counts[asked])] if asked in tasks else []
    return f"{', '.join([*own, *others]) or 0} of {counts.total()}"


def _solved(seeds: Rows) -> str:
    return _rates([[row.success for row in rows] for rows in seeds.values()])


def _rates(seeds: Sequence[Sequence[bool]]) -> str:
    """Of all seeds that were tried, and of each where there are several."""
    tried = [seed for seed in seeds if seed]
    if not tried:
        return "-"
    all_of_them, *each = (f"{100 * sum(trials) / len(trials):.0f}" for trials in ([*chain(*tried)], *tried))
    return f"{all_of_them} %" + (f" ({', '.join(each)})" if len(each) > 1 else "")


def _table(rows: Sequence[Sequence[str]]) -> str:
    return "".join("| " + " | ".join(row) + " |\n" for row in [rows[0], ["---"] * len(rows[0]), *rows[1:]])


def _short(task: str) -> str:
    return task.replace("put_the_", "").replace("_", " ")


def plot(results: Sequence[PolicyResults], file: Path) -> None:
    """Success by line and arm, with Wilson's 95 % interval, and each seed as a dot."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3), layout="constrained")
    axes = figure.add_subplot()
    arms = list(dict.fromkeys(one.arm for one in results))
    for place, arm in enumerate(arms):
        for number, line in enumerate(lines_of(results)):
            seeds = of_line(results, line)[arm]
            rate = success_rate([*chain.from_iterable(seeds.values())])
            # All seeds act in the same tasks, so that they are no further trials.
            low, high = wilson(rate["successes"] / len(seeds), rate["episodes"] / len(seeds))
            x, height = number + 0.8 * (place + 0.5) / len(arms) - 0.4, 100 * rate["rate"]
            spread = [[height - 100 * low], [100 * high - height]]
            axes.bar(x, height, 0.7 / len(arms), color=COLOURS[place], label=arm if number == 0 else None)
            axes.errorbar(x, height, spread, color="black", linewidth=0.8)
            each = [100 * success_rate(rows)["rate"] for rows in seeds.values()]
            axes.plot([x] * len(each), each, "o", color="black", markersize=2.5)
    named = [LINES[line] for line in lines_of(results)]
    axes.set_xticks(range(len(named)), named)
    axes.set_ylabel("success (%)")
    axes.set_ylim(0, 100)
    figure.legend(loc="outside upper center", ncols=len(arms), frameon=False)
    with mpl.rc_context({"svg.hashsalt": "effect", "svg.fonttype": "none"}), replaced(file) as temporary:
        figure.savefig(temporary, format="svg", metadata={"Date": None})


def publish(folder: Path, docs: Path = DOCS) -> str:
    """Write the table of a folder's results into docs/effect.md, and the plot beside it; returns the table.

    Those of the further experiments go into docs/decisions.md.
    """
    results = read(folder)
    text = markdown(results) + "\n![success by tests and arm](effect.svg)\n"
    plot(results, docs / "effect.svg")
    _write(docs / "effect.md", "table", text)
    for further in sorted(FURTHER.iterdir()):
        beside = read(FURTHER / BESIDE[further.name]) if further.name in BESIDE else []
        _write(docs / "decisions.md", further.name, markdown([*beside, *read(further)]))
    return text


def _write(page: Path, name: str, text: str) -> None:
    """Replace what stands between two marks of a page."""
    before, _, rest = page.read_text().partition(f"<!-- {name} -->\n")
    _, end, after = rest.partition(f"<!-- end of {name} -->")
    assert end, f"{page} has no marks of {name}"
    write(page, f"{before}<!-- {name} -->\n{text}{end}{after}")
