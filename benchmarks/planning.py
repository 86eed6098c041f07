"""How long the plan of ``configs/paper.yaml`` takes on the starter demonstrations, with the report on leakage."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.config import DemosConfig, load
from pipeline.planning import leakage, plan
from pipeline.testset import benchmark


def main() -> None:
    config = load(Path("configs/paper.yaml"))
    took_s: dict[str, float] = {}

    @contextmanager
    def timed(what: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        took_s[f"{what}_s"] = round(time.perf_counter() - wall, 2)
        took_s[f"{what}_cpu_s"] = round(time.process_time() - cpu, 2)

    with timed("all"), tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plan.parquet"
        with timed("index"):
            entries = DemosConfig().index().entries
        with timed("testset"):
            test = benchmark.load()
        with timed("draw"):
            rows = plan.make(entries, config.plan, config.replay, test)
        with timed("write"):
            plan.write(rows, file)
        with timed("leakage"):
            findings = leakage.check(plan.read(file), test)
        size_mb = file.stat().st_size / 1e6
    figures = {
        "rows": len(rows),
        "perturbed": sum(row.role == "perturbed" for row in rows),
        "overlaps": sum(finding.overlaps for finding in findings.values()),
        "file_mb": round(size_mb, 2),
        **took_s,
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
