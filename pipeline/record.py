"""Record of finished work: its inputs, the recipes and versions that generated it, and its files.

Every part of this project that skips finished work asks such a record whether the work is up to date: the files of the
stores, the datasets, the outputs of the stages, and the results of an evaluation.
"""

import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from pipeline.seeding import digest

NAMED = 3
"""Number of differing settings and files that a description names."""


@dataclass(frozen=True)
class Basis:
    """Everything that the bytes of some outputs depend on.

    Attributes:
        identity: digest of all of it.
        requested: the part that a user chooses, such as settings and input files; JSON-serialisable.
        made_with: the part that comes with the installation and the machine: names for people to recipes, versions and
            devices.
    """

    identity: str
    requested: Any
    made_with: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, requested: object, made_with: Mapping[str, str]) -> "Basis":
        """Return the basis whose identity is a digest of its two parts."""
        as_stored = json.loads(json.dumps(requested))
        return cls(digest(as_stored, made_with)[:16], as_stored, made_with)


@dataclass(frozen=True)
class Record:
    """Basis of finished outputs, and their files.

    Attributes:
        basis: everything that the outputs were generated from and with.
        files: path of each file to its SHA-256; empty where the files have checksums of their own.
    """

    basis: Basis
    files: Mapping[str, str] = field(default_factory=dict)

    def matches(self, basis: Basis) -> bool:
        """Return whether outputs of this basis would be the same."""
        return self.basis.identity == basis.identity

    def same_request(self, basis: Basis) -> bool:
        """Return whether the requests are equal, so that only the installation or the machine can differ."""
        return bool(self.basis.requested == basis.requested)

    def describe_mismatch(self, basis: Basis, unnamed: Collection[str] = ()) -> str | None:
        """Describe why the record does not match; `None` if it does.

        Args:
            unnamed: names of ``made_with`` whose values are left out of the description.
        """
        if self.matches(basis):
            return None
        if not self.same_request(basis):
            names = list(_changed(self.basis.requested, basis.requested))
            further = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
            return f"changed {', '.join(names[:NAMED])}{further}"
        return differences(self.basis.made_with, basis.made_with, unnamed)


def differences(then: Mapping[str, str], now: Mapping[str, str], unnamed: Collection[str] = ()) -> str:
    """Describe the differences of two ``made_with`` in words; empty if they are equal.

    Args:
        unnamed: names whose values are left out.
    """
    descriptions: list[str] = []
    for name in dict.fromkeys([*unnamed, *then, *now]):
        if then.get(name) == now.get(name):
            continue
        if name in unnamed:
            descriptions.append(f"other {name}")
        else:
            descriptions.append(f"{name} {then.get(name, 'none')}, here {now.get(name, 'none')}")
    return ", ".join(descriptions)


_ABSENT = object()


def _changed(then: Any, now: Any, path: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield the differing parts of two requests, such as ``plan.seed`` or ``plan.parquet``.

    Args:
        path: keys to this part. The first key is a group, such as ``settings`` or ``files``, which is left out.
    """
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys([*then, *now]):
            yield from _changed(then.get(key, _ABSENT), now.get(key, _ABSENT), (*path, key))
    elif then != now:
        yield ".".join(path[1:] or path) or "settings or input files"
