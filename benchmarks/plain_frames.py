"""Check that the frames of a finished run equal those of the plain renderer, byte for byte.

    nice -n 10 python benchmarks/plain_frames.py data/starter [--every N]

The script renders every frame of each stored stream of the run's kept episodes again, without savings
(PLAIN_RENDERING=1). It encodes the frame as JPEG and compares the bytes. It takes several times as long as the run's
stage render; ``--every N`` compares every N-th frame of each stream. The device must be the run's. No code is shared
with the run's own loop over frames (``rendering/render.py``). The last line is JSON: kept episodes, streams, frames
compared, and the number of different frames.
"""

import argparse
import json
import os
from contextlib import closing
from pathlib import Path

os.environ["PLAIN_RENDERING"] = "1"


import cv2
import numpy as np

from pipeline import gl
from pipeline.axes import PixelPerturbation, RenderPerturbation, of_layer
from pipeline.config import load
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.files import read_json
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.planning import plan
from pipeline.planning.streams import Stream, streams_of
from pipeline.rendering.renderer import Renderer
from pipeline.stores.frame_store import FrameStore, frames_by_trajectory
from pipeline.stores.trajectory_store import TrajectoryStore


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="folder of a run, data/<name> in a checkout")
    parser.add_argument("--every", type=int, default=1, help="compare every N-th frame of a stream")
    arguments = parser.parse_args()
    data = arguments.data.resolve()
    config = load(data.resolve() / read_json(data / "configuration.json")["configuration"])
    store, trajectories = FrameStore(data / "frames", config.render), TrajectoryStore(data / "trajectories")
    stored_rows = frames_by_trajectory(store.rows())
    if any(stored_row.device != gl.choose().device for stored_row in stored_rows.values()) or not stored_rows:
        raise PipelineError(
            "there are no up-to-date frames, or another device rendered them",
            where=store.root,
            expected=gl.choose().device,
        )
    streams: dict[str, dict[str, Stream]] = {}
    episodes = 0
    for row in plan.read(data / "plan.parquet"):
        wanted = {stream.stream_id: stream for stream in streams_of(row.perturbations).values()}
        if row.trajectory_id in stored_rows and wanted.keys() <= stored_rows[row.trajectory_id].streams:
            streams.setdefault(row.trajectory_id, {}).update(wanted)
            episodes += 1
    frames, different = 0, 0
    for number, (trajectory_id, wanted) in enumerate(streams.items(), start=1):
        trajectory, stored = trajectories.load(trajectory_id), store.load(trajectory_id, wanted)
        with closing(Renderer(trajectory.model_xml)) as renderer:
            for stream_id, stream in wanted.items():
                with renderer.perturbed(of_layer(stream.perturbations, RenderPerturbation)):
                    for step in range(0, len(trajectory.actions), arguments.every):
                        renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
                        file = as_stored(renderer, stream, step, config.render.jpeg_quality)
                        frames += 1
                        different += file != stored.streams[stream_id][step]
        print(f"{number} of {len(streams)} trajectories: {frames} frames, {different} different", flush=True)
    print(
        json.dumps(
            {
                "episodes": episodes,
                "streams": sum(map(len, streams.values())),
                "every": arguments.every,
                "frames": frames,
                "different": different,
            }
        )
    )


def as_stored(renderer: Renderer, stream: Stream, step: int, jpeg_quality: int) -> bytes:
    """Render a stream's frame in the restored state; return its JPEG file."""
    frame = renderer.frame(SCHEMA.views[stream.view].camera)
    for noise in of_layer(stream.perturbations, PixelPerturbation):
        frame = noise.apply(frame, step)
    bgr = np.ascontiguousarray(frame[::-1, ::-1, ::-1])
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1].tobytes()


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
