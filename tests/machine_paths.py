"""Looks through files of every kind for paths of the machine that they were made on."""

import base64
import json
import re
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from zipfile import ZipFile

import h5py
import numpy as np
import pyarrow.parquet as pq
from conftest import REPOSITORY
from PIL import Image

from pipeline.formats.tfrecord import records

OF_THIS_MACHINE = {
    str(path)
    for path in (REPOSITORY, Path(sys.prefix), Path.home(), Path(tempfile.gettempdir()))
    if len(path.parts) > 1  # a home of / says nothing
}


def told(file: Path, paths: Iterable[str] = frozenset()) -> set[str]:
    """Those of the machine's paths, and of ``paths``, that a file holds."""
    wanted = {path: re.compile(rb"(?<![\w/.-])" + re.escape(path.encode()) + rb"(?![\w.-])") for path in
              (*OF_THIS_MACHINE, *paths)}  # fmt: skip
    return {path for content in _contents(file) for path, pattern in wanted.items() if pattern.search(content)}


def _contents(file: Path) -> Iterator[bytes]:
    """What a file says, unpacked, and its bytes as they are."""
    raw = file.read_bytes()
    match file.suffix:
        case ".parquet":
            table = pq.read_table(file)
            yield json.dumps(table.to_pylist(), default=repr).encode()
            for metadata in (table.schema.metadata or {}, *(field.metadata or {} for field in table.schema)):
                yield b" ".join((*metadata.keys(), *metadata.values()))
        case ".npz":
            with ZipFile(file) as archive:
                yield from map(archive.read, archive.namelist())
        case ".hdf5":
            with h5py.File(file) as opened:
                yield from _in_hdf5(opened)
        case ".html":
            inside = re.compile(rb"base64,([A-Za-z0-9+/=]+)")
            yield from (base64.b64decode(packed) for packed in inside.findall(raw))
            raw = inside.sub(b"", raw)
        case ".png":
            with Image.open(file) as image:
                yield repr(image.info).encode()
    if "tfrecord" in file.name:
        yield from records(file)
    yield raw


def _in_hdf5(opened: h5py.File) -> Iterator[bytes]:
    items: list[h5py.HLObject] = [opened]
    opened.visititems(lambda name, item: items.append(item))
    for item in items:
        yield " ".join(f"{name} {value}" for name, value in item.attrs.items()).encode()
        if isinstance(item, h5py.Dataset):
            values = item[()]
            texts = isinstance(values, bytes) or np.asarray(values).dtype == object
            yield b" ".join(map(bytes, np.ravel(values))) if texts else np.asarray(values).tobytes()
