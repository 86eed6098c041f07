"""Stage leakage: compare every planned perturbation with the benchmark's test tasks, and stop where one overlaps."""

from rich.console import Console

from pipeline.config import Config
from pipeline.planning import leakage, plan
from pipeline.run.stage import main
from pipeline.testset import benchmark


def run(config: Config) -> None:
    findings = leakage.check(plan.read(config.data / "plan.parquet"), benchmark.load())
    leakage.write(findings, config.data / "leakage.json")
    Console().print(leakage.report(findings))
    leakage.refuse_overlap(findings)


if __name__ == "__main__":
    main(run, __doc__)
