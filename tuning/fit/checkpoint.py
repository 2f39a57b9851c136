"""The state of a long job in one file: whole or not at all, checked before it is used, without pickle.

An ``.npz`` with the leaves and a JSON head, and the SHA-256 of all its bytes behind it, where zip readers do not look.
It is written under another name, flushed to the disk and renamed, so that a crash at any moment leaves the old one.
"""

import hashlib
import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxnav.types import DataError, Json, Tree

MAX_BYTES = 1 << 30  # of the unpacked file
DIGEST = hashlib.sha256().digest_size


class CheckpointError(DataError):
    """A checkpoint that cannot be used: damaged, or of another job."""


class Checkpoint(NamedTuple):
    """The saved state."""

    tree: Tree
    head: Json


def save(path: str | os.PathLike[str], tree: Tree, head: Json, identity: str = "") -> None:
    """Write the leaves of ``tree`` and the plain values of ``head`` (JSON; floats come back bit for bit).

    ``identity`` identifies the job; `load` asks for the same.

    Raises:
        CheckpointError: a leaf of a type that numpy does not have.
    """
    path = Path(path)
    leaves = {_name(i): np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}
    for leaf in leaves.values():
        if leaf.dtype.kind not in "biufc":  # such as bfloat16, which numpy writes and cannot read
            raise CheckpointError(f"{path}: numbers of type {leaf.dtype} cannot be kept in a file")
    about = {"identity": identity, "tree": str(jax.tree.structure(tree)), "head": head}
    text = json.dumps(about, sort_keys=True)
    buffer = io.BytesIO()
    arrays: Json = {"about": np.frombuffer(text.encode(), np.uint8)} | leaves
    np.savez(buffer, **arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with open(temporary, "wb") as file:
        file.write(buffer.getbuffer())
        file.write(hashlib.sha256(buffer.getbuffer()).digest())
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    folder = os.open(path.parent, os.O_RDONLY) if hasattr(os, "O_DIRECTORY") else None
    if folder is not None:  # the rename too
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def load(path: str | os.PathLike[str], like: Tree, identity: str = "") -> Checkpoint:
    """Read a checkpoint for a tree of the structure, shapes and dtypes of ``like``; its leaves where that is None.

    Raises:
        CheckpointError: absent, damaged in any way, or of another job.
    """
    path = Path(path)
    try:
        about, leaves = _read(path)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # zip, json, numpy and zlib each have other types
        raise CheckpointError(f"{path}: damaged checkpoint ({error}); start without --resume") from error
    if about["identity"] != identity:
        raise CheckpointError(f"{path}: of another job: saved {about['identity']!r}, this is {identity!r}")
    if like is None:
        return Checkpoint([leaves[_name(i)] for i in range(len(leaves))], about["head"])
    flat, structure = jax.tree.flatten(like)
    fits = about["tree"] == str(structure) and len(leaves) == len(flat)
    ordered = [leaves[_name(i)] for i in range(len(flat))] if fits else []
    if not fits or any((a.shape, a.dtype) != _kind(b) for a, b in zip(ordered, flat, strict=True)):
        raise CheckpointError(f"{path}: holds another optimiser or other parameters than this job")
    return Checkpoint(jax.tree.unflatten(structure, ordered), about["head"])


def _kind(leaf: Any) -> tuple[tuple[int, ...], np.dtype]:
    leaf = np.asarray(leaf)
    return leaf.shape, leaf.dtype


def _name(i: int) -> str:
    return f"leaf{i}"


def _read(path: Path) -> tuple[Json, dict[str, np.ndarray]]:
    data = path.read_bytes()
    if hashlib.sha256(data[:-DIGEST]).digest() != data[-DIGEST:]:
        raise ValueError("digest differs")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(info.file_size for info in archive.infolist()) > MAX_BYTES:
            raise ValueError("too large")
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        leaves = {name: archive[name] for name in archive.files}
    about = json.loads(leaves.pop("about").tobytes().decode())
    if not isinstance(about, dict) or not {"identity", "tree", "head"} <= set(about):
        raise ValueError("no head")
    return about, leaves
