"""Writer of shards and metadata of RLDS sets, without TensorFlow.

Feature names, shapes and dtypes are those of OpenVLA's ``libero_*_no_noops`` sets (hub:
``openvla/modified_libero_rlds``). Provenance, labels and the cameras' matrices are added to ``episode_metadata``,
extras to ``observation``; the loaders ignore these additions.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import tensorflow_datasets as tfds
from numpy.typing import NDArray

from pipeline.episode_check import check
from pipeline.episode_schema import MATRICES, SCHEMA, Content, MapSpec, MatrixSpec, VectorSpec, labels_of
from pipeline.files import read_json, schema_file
from pipeline.formats.episodes import Load
from pipeline.formats.rlds_layout import VERSION, split_of
from pipeline.formats.tfrecord import OVERHEAD_BYTES, framed
from pipeline.types import Episode


def write_shard(path: Path, episode_ids: Sequence[str], load: Load, content: Content) -> None:
    """Write a TFRecord file of episodes with this content.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    with path.open("wb") as file:
        for episode_id in episode_ids:
            episode = load(episode_id)
            check(episode, content)
            encoded = features(content).encode_example(_nested_example(episode))
            example = _serializer(content).get_tf_example(encoded)
            # protobuf otherwise orders its map differently in every process.
            file.write(framed(example.SerializeToString(deterministic=True)))


def write_metadata(folder: Path, lengths: Mapping[Path, int], content: Content) -> None:
    """Write the files that TFDS reads in addition to the shards.

    Args:
        folder: ``<name>/1.0.0``.
        lengths: each shard of the folder, in order, to its number of episodes.
        content: content of the episodes.
    """
    infos = []
    for split_name in sorted({split_of(shard) for shard in lengths}):
        template = tfds.core.ShardedFileTemplate(
            data_dir=folder, dataset_name=folder.parent.name, split=split_name, filetype_suffix="tfrecord"
        )
        shards = {shard: length for shard, length in lengths.items() if split_of(shard) == split_name}
        stored = sum(shard.stat().st_size - OVERHEAD_BYTES * length for shard, length in shards.items())
        infos.append(
            tfds.core.SplitInfo(
                name=split_name, shard_lengths=list(shards.values()), num_bytes=stored, filename_template=template
            )
        )
    tfds.folder_dataset.write_metadata(
        data_dir=folder,
        features=features(content),
        split_infos=infos,
        version=VERSION,
        filename_template=template,
        check_data=False,  # The check needs TensorFlow.
        **texts(content),
    )


def texts(content: Content) -> dict[str, str]:
    """Return the texts of ``dataset_info.json`` for people."""
    kept, end = ("miss the goal", "failure") if content.is_of_failures else ("solve the task", "success")
    return {
        "description": f"LIBERO demonstrations, perturbed, replayed in simulation and kept when they {kept}. "
        f"Robot: Franka Panda. Every episode ends in {end}; episode_metadata says what was changed.",
        "homepage": "https://libero-project.github.io",
        "citation": schema_file("citation.bib").read_text(),
        "license": "LIBERO's demonstrations: CC BY 4.0. README.md of the dataset names what its textures and objects "
        "owe.",
    }


@cache
def features(content: Content) -> Any:
    """Return the feature tree (``tfds.features.FeaturesDict``)."""
    frame = partial(
        tfds.features.Image,
        shape=content.frame_shape,
        dtype=np.dtype(SCHEMA.frame.dtype),
        encoding_format=SCHEMA.frame.encoding,
    )
    rotated = f"RGB, before the action, rotated by {SCHEMA.image_rotation_deg} degrees from how MuJoCo renders it"
    observation = {view: frame(doc=f"camera {spec.camera}: {rotated}") for view, spec in content.cameras.items()}
    observation |= {"state": _tensor(SCHEMA.state), "joint_state": _tensor(SCHEMA.joint_state)}
    for name in content.maps:
        observation |= {f"{view}_{name}": _map(getattr(SCHEMA, name), content) for view in content.views}
    if "boxes" in content.extras:
        observation |= {f"{view}_boxes": _tensor(SCHEMA.boxes) for view in content.views}
    if "object_poses" in content.extras:
        observation["object_poses"] = _tensor(SCHEMA.object_poses)
    scalar = tfds.features.Scalar
    failures = content.is_of_failures
    step = {
        "observation": observation,
        "action": _tensor(SCHEMA.action),
        "action_absolute": _tensor(SCHEMA.action_absolute),
        "discount": scalar(np.float32, doc="always 1"),
        "reward": scalar(np.float32, doc="always 0" if failures else "1 on the last step, else 0"),
        "is_first": scalar(np.bool_, doc="first step of the episode"),
        "is_last": scalar(np.bool_, doc="last step of the episode"),
        "is_terminal": scalar(
            np.bool_,
            doc=f"{'never' if failures else 'last step'}: every episode ends in {'failure' if failures else 'success'}",
        ),
        "language_instruction": tfds.features.Text(doc="what the policy is asked to do"),
    }
    metadata = {"file_path": tfds.features.Text(doc="where the demonstration was published, as demo_source")}
    meanings = {column["name"]: column["meaning"] for column in read_json(schema_file("manifest.json"))["columns"]}
    meanings["success"] = "whether the goal was reached: false"
    for key, dtype in content.provenance.items():
        doc = meanings[key]
        metadata[key] = tfds.features.Text(doc=doc) if dtype == "string" else scalar(np.dtype(dtype), doc=doc)
    metadata |= {f"{view}_{name}": _tensor(getattr(SCHEMA, name)) for view in content.views for name in MATRICES}
    if content.has_names:
        metadata["instances"] = tfds.features.Text(doc="JSON list of names, whose places the extras use")
    for key, dtype in SCHEMA.labels.items():
        value = tfds.features.Text() if dtype == "string" else scalar(np.dtype(dtype))
        metadata[key] = tfds.features.Sequence(value, doc=meanings[key])
    return tfds.features.FeaturesDict({"steps": tfds.features.Dataset(step), "episode_metadata": metadata})


def _tensor(spec: VectorSpec | MatrixSpec) -> Any:
    names = f": {', '.join(spec.names)}" if isinstance(spec, VectorSpec) else ""
    return tfds.features.Tensor(shape=spec.shape, dtype=np.dtype(spec.dtype), doc=spec.meaning + names)


def _map(spec: MapSpec, content: Content) -> Any:
    return tfds.features.Image(
        shape=(content.size_px, content.size_px, 1),
        dtype=np.dtype(spec.dtype),
        encoding_format=spec.encoding,
        doc=spec.meaning,
    )


@cache
def _serializer(content: Content) -> Any:
    return tfds.core.ExampleSerializer(features(content).get_serialized_info())


def _nested_example(episode: Episode) -> dict[str, Any]:
    """Return an episode as TFDS nests its features. TFDS stores an image that is given as bytes without a change."""
    last = len(episode) - 1
    success = bool(episode.provenance.get("success", True))
    columns: dict[str, Sequence[Any] | NDArray[Any]] = {**episode.frames}
    columns |= {"state": episode.state, "joint_state": episode.joint_state}
    if episode.object_poses is not None:
        columns["object_poses"] = episode.object_poses
    for view, geometry in episode.geometry.items():
        columns |= {f"{view}_{name}": files for name, files in geometry.maps.items()}
        if geometry.boxes is not None:
            columns[f"{view}_boxes"] = geometry.boxes
    steps = []
    for t in range(len(episode)):
        step = {
            "observation": {name: values[t] for name, values in columns.items()},
            "action": episode.action[t],
            "action_absolute": episode.action_absolute[t],
            "discount": 1.0,
            "reward": float(success and t == last),
            "is_first": t == 0,
            "is_last": t == last,
            "is_terminal": success and t == last,
            "language_instruction": episode.instruction,
        }
        steps.append(step)
    metadata: dict[str, Any] = {"file_path": episode.provenance["demo_source"], **episode.provenance}
    for view, geometry in episode.geometry.items():
        metadata |= {f"{view}_{name}": getattr(geometry, name) for name in MATRICES}
    if episode.instances:
        metadata["instances"] = json.dumps(list(episode.instances))
    metadata |= labels_of(episode)
    return {"steps": steps, "episode_metadata": metadata}
