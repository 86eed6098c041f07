"""Check of the statistics that a dataset states of an episode."""

from collections.abc import Iterator

import numpy as np

from pipeline.formats.read_back import Fault
from pipeline.formats.stated_statistics import FIGURES, complete, wrong_depth, wrong_numbers, wrong_pixels, wrong_sample
from pipeline.validation.case import Case


def check_statistics(case: Case) -> Iterator[Fault]:
    """Compare each episode's statistics with its numbers, and those of its views with the stored frames."""
    for copy in case.comparable_copies:
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
            wrong += wrong_sample(column, stated, case.sampled_levels[view], len(case.episode))
            if case.decodes_all_frames:
                wrong += wrong_pixels(column, stated, case.levels[view], quantiles)
        for view, column in statistics.depth.items():
            stated = stored.get(column, {})
            lacking = [*complete(column, stated, figures, 1)]
            sample_m = [map_m for (name, _), map_m in case.sampled_depth_m.items() if name == view]
            maps_m = case.depth_m(view) if case.decodes_all_frames else np.stack(sample_m)
            wrong += lacking or wrong_depth(column, stated, maps_m, len(case.episode), quantiles)
        for what, expected in wrong:
            yield case.finding(copy.dataset, what, expected)
