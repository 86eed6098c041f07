"""Reading of a run's manifest with pandas: python examples/read_manifest.py data/starter

The manifest has a row for every planned episode, kept or dropped. ``episode_id`` joins it with both datasets. The run
must have perturbed episodes, and datasets of RLDS and LeRobot.
``schemas/manifest.json`` describes each column.
"""

import argparse
import json
from pathlib import Path

import pandas as pd


def main(run: Path) -> None:
    manifest = pd.read_parquet(run / "manifest.parquet")
    print(f"{len(manifest)} planned, {manifest.kept.sum()} kept")
    print(manifest.groupby(["axis", "reason"]).size().unstack(fill_value=0).to_string())

    kept = manifest[manifest.kept].astype({"lerobot_episode_index": int, "rlds_index": int})
    # Every parameter of the perturbations, as JSON; an episode of several axes has several perturbations.
    perturbations = kept.perturbations.map(json.loads)
    print(f"parameters of one episode: {perturbations[perturbations.str.len() > 0].iloc[0]}")

    first = kept.iloc[0]
    for start, text in zip(first.subtask_starts, first.subtask_texts, strict=True):
        print(f"{first.episode_id}, from step {start}: {text}")
    print(f"{len(kept)} episodes have {kept.actions_sha256.nunique()} distinct action sequences")

    # Pairs for a comparison: a perturbed episode and the clean episode of its demonstration.
    pairs = kept[kept.role == "perturbed"].merge(kept, left_on="twin_id", right_on="episode_id", suffixes=("", "_twin"))
    index = "lerobot_episode_index"
    print(f"{len(pairs)} pairs")
    print(pairs[["axis", "component", "level", index, f"{index}_twin"]].to_string(index=False))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    main(parser.parse_args().run)
