"""Search of files of every kind for paths of the machine that wrote them."""

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
from checkout import REPOSITORY
from PIL import Image

from pipeline.formats.tfrecord import records

MACHINE_FOLDERS = (REPOSITORY, Path(sys.prefix), Path.home(), Path(tempfile.gettempdir()))
OF_THIS_MACHINE = {str(folder) for folder in MACHINE_FOLDERS if len(folder.parts) > 1}
"""Paths of this machine, except a home of /, which every file may contain."""


def told(file: Path, paths: Iterable[str] = frozenset()) -> set[str]:
    """Return the machine's paths, and those of ``paths``, that a file contains."""
    patterns: dict[str, re.Pattern[bytes]] = {}
    for path in (*OF_THIS_MACHINE, *paths):
        patterns[path] = re.compile(rb"(?<![\w/.-])" + re.escape(path.encode()) + rb"(?![\w.-])")
    contained: set[str] = set()
    for content in _contents(file):
        contained |= {path for path, pattern in patterns.items() if pattern.search(content)}
    return contained


def _contents(file: Path) -> Iterator[bytes]:
    """Yield the unpacked contents of a file, and its raw bytes."""
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
