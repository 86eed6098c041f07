"""Part of a configuration that is small enough for a measurement."""

from collections.abc import Sequence

from pipeline.config import Config, DemosConfig
from pipeline.libero.tasks import select_tasks
from pipeline.validation.needs import PUBLISHED


def sliced(config: Config, tasks: Sequence[str] | None) -> Config:
    """Reduce a configuration to one demonstration of each task and its share of the episodes."""
    patterns = tuple(tasks or config.demos.tasks)
    chosen = len(select_tasks(patterns))
    per_task = config.demos.per_task or (PUBLISHED if config.demos.source == "hdf5" else 1)
    whole = len(select_tasks(config.demos.tasks)) * per_task
    episodes = {name: max(1, round(number * chosen / whole)) for name, number in config.plan.episodes.items()}
    return config.model_copy(
        update={
            "demos": DemosConfig(source="starter", tasks=patterns),
            "plan": config.plan.model_copy(update={"episodes": episodes}),
        }
    )
