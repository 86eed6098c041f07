"""Stage leakage: compare every planned perturbation with the benchmark's test tasks, and stop where one overlaps."""

from rich.console import Console

from pipeline import leakage, plan, testset
from pipeline.config import Config
from pipeline.stage import main


def run(config: Config) -> None:
    findings = leakage.check(plan.read(config.data / "plan.parquet"), testset.load())
    leakage.write(findings, config.data / "leakage.json")
    Console().print(leakage.report(findings))
    leakage.refuse_overlap(findings)


if __name__ == "__main__":
    main(run, __doc__)
