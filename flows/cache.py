"""Artefacts by content: values of stages as safetensors files, written once, checked whenever they are read.

Layout: ``<store>/<stage>/<key>/<output>.safetensors`` beside a ``meta.json``. A folder appears by one rename after its
files are on the disk, so it is whole or not there. Nothing is ever unpickled.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout
from safetensors import SafetensorError
from safetensors.numpy import load as load_safetensors
from safetensors.numpy import save as save_safetensors

from tasks.errors import InputError
from tasks.values import VALUES

HEADER = "skelebones"  # one metadata entry only: safetensors does not keep the order of several


class CorruptArtefact(Exception):
    """An artefact whose bytes are not those that were written; the sweep drops and recomputes it."""

    def __init__(self, stage: str, key: str) -> None:
        super().__init__(f"artefact {stage}/{key[:12]} is damaged")
        self.stage, self.key = stage, key

    def __reduce__(self):
        return CorruptArtefact, (self.stage, self.key)


@dataclass(frozen=True)
class Ref:
    """Points at one stored artefact; the only thing that travels through Prefect. outputs: name -> content digest."""

    stage: str
    key: str
    outputs: dict[str, str]
    seconds: float
    peak_mb: float
    cached: bool = False


@dataclass(frozen=True)
class Artefact:
    """A stored artefact as its meta.json describes it. outputs: name -> content digest, empty where it cannot be read;
    size: bytes of its files; written: when, in seconds since the epoch; seconds, peak_mb: what computing it cost."""

    stage: str
    key: str
    size: int
    written: float
    function: str = ""
    case: str = ""
    settings: dict = field(default_factory=dict)
    outputs: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    peak_mb: float = 0.0


def encode(value: object) -> bytes:
    """A value of ``tasks.values`` as safetensors bytes: arrays as tensors, the rest as one JSON header."""
    arrays: dict[str, np.ndarray] = {}
    header = _describe(value, "", arrays)
    return save_safetensors(arrays, {HEADER: canonical_json(header)})


def decode(data: bytes) -> object:
    """The inverse of :func:`encode`."""
    length = int.from_bytes(data[:8], "little")
    header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][HEADER])
    return _restore(header, "", load_safetensors(data))


def canonical_json(value: object) -> str:
    """JSON with sorted keys and no spaces: the same text for equal values, so that it can be hashed."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


class Store:
    """A folder of artefacts; safe for several processes at once."""

    def __init__(self, path: str | os.PathLike, *, create: bool = True) -> None:
        self.path = Path(path).expanduser()
        if create:
            with explained(self.path):
                self.path.mkdir(parents=True, exist_ok=True)

    def folder(self, stage: str, key: str) -> Path:
        """Where an artefact lies, whether or not it is there."""
        return self.path / stage / key

    def scratch(self, stage: str, key: str) -> Path:
        """A folder for what a long stage has so far; whoever holds the artefact's lock owns it."""
        return self.path / stage / f"{key}.part"

    @contextmanager
    def lock(self, stage: str, key: str, wait: float = -1) -> Iterator[None]:
        """Holds the artefact's lock. It belongs to the process and dies with it, so no crash leaves it behind; its file
        stays until :meth:`sweep_locks`.

        wait: seconds to wait for another holder before filelock's Timeout is raised; -1 for as long as it takes.
        """
        target = self.folder(stage, key)
        with explained(self.path):
            target.parent.mkdir(parents=True, exist_ok=True)
            lock = FileLock(f"{target}.lock")
            lock.acquire(wait)
        try:
            yield
        finally:
            lock.release()

    def sweep_locks(self) -> None:
        """Removes the lock files that nobody holds.

        Safe beside runs: only who holds a file removes it, and filelock tells whoever waited for it to open a new one.
        """
        for file in sorted(self.path.glob("*/*.lock")):
            with suppress(Timeout, PermissionError), FileLock(file, timeout=0):  # Windows keeps files that are open
                file.unlink(missing_ok=True)

    def find(self, stage: str, key: str) -> Ref | None:
        """The artefact, if it is there with every file at its recorded size."""
        folder = self.folder(stage, key)
        try:
            meta = json.loads((folder / "meta.json").read_text("utf-8"))
            outputs = meta["outputs"]
            if all((folder / f"{n}.safetensors").stat().st_size == o["bytes"] for n, o in outputs.items()):
                digests = {n: o["digest"] for n, o in outputs.items()}
                return Ref(stage, key, digests, meta["seconds"], meta["peak_mb"], cached=True)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None  # absent or cut short: compute it again
        return None

    def artefacts(self) -> list[Artefact]:
        """All artefacts, by stage and key; a folder whose meta.json cannot be read is one that says nothing."""
        return [_read(folder) for folder in sorted(self.path.glob("*/*")) if _is_artefact(folder)]

    def damage(self, artefact: Artefact) -> str:
        """What is wrong with an artefact's files, or "" where every digest is right."""
        if not artefact.outputs:
            return "meta.json cannot be read"
        for name, digest in artefact.outputs.items():
            file = self.folder(artefact.stage, artefact.key) / f"{name}.safetensors"
            try:
                with open(file, "rb") as stream:
                    found = hashlib.file_digest(stream, "sha256").hexdigest()
            except OSError as error:
                return f"{file.name}: {error.strerror or error}"
            if found != digest:
                return f"{file.name} holds other bytes than were written"
        return ""

    def put(self, stage: str, key: str, values: dict[str, object], meta: dict) -> Ref:
        """Writes an artefact; the caller holds its lock. A damaged predecessor is replaced."""
        target = self.folder(stage, key)
        draft = target.with_name(f"{key}.tmp")  # one name a key: what a crash left is wiped by the next writer
        with explained(self.path):
            for stale in (draft, target):
                if stale.exists():
                    shutil.rmtree(stale)
            draft.mkdir(parents=True)
            outputs = {}
            for name, value in values.items():
                data = encode(value)
                _write(draft / f"{name}.safetensors", data)
                outputs[name] = {
                    "kind": type(value).__name__,
                    "bytes": len(data),
                    "digest": hashlib.sha256(data).hexdigest(),
                }
            text = json.dumps({"stage": stage, "key": key, **meta, "outputs": outputs}, indent=1, sort_keys=True)
            _write(draft / "meta.json", text.encode())
            os.replace(draft, target)
            _sync_folder(target.parent)
        return Ref(stage, key, {n: o["digest"] for n, o in outputs.items()}, meta["seconds"], meta["peak_mb"])

    def load(self, ref: Ref, output: str) -> object:
        """One output of an artefact. Raises CorruptArtefact when its bytes are not those that were written."""
        try:
            data = (self.folder(ref.stage, ref.key) / f"{output}.safetensors").read_bytes()
        except FileNotFoundError:
            raise CorruptArtefact(ref.stage, ref.key) from None
        if hashlib.sha256(data).hexdigest() != ref.outputs[output]:
            raise CorruptArtefact(ref.stage, ref.key)
        try:
            return decode(data)
        except (ValueError, LookupError, TypeError, AttributeError, SafetensorError) as error:
            # bytes that no version of ours wrote, though their digest fits: planted, or a value that has changed since
            raise CorruptArtefact(ref.stage, ref.key) from error

    def drop(self, stage: str, key: str) -> None:
        """Removes an artefact, so that it is computed again."""
        with self.lock(stage, key), explained(self.path):
            shutil.rmtree(self.folder(stage, key), ignore_errors=True)


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turns a full, read-only or forbidden disk into one clear line."""
    try:
        yield
    except OSError as error:
        reasons = {
            errno.ENOSPC: ("free space", "a full disk"),
            errno.EDQUOT: ("free space", "an exhausted quota"),
            errno.EROFS: ("a writable folder", "a read-only file system"),
            errno.EACCES: ("a writable folder", "no permission to write"),
            errno.EPERM: ("a writable folder", "no permission to write"),
            errno.ENOTDIR: ("a folder", "a file in its place"),
            errno.EEXIST: ("a folder", "a file in its place"),
        }
        if error.errno not in reasons:
            raise
        expected, found = reasons[error.errno]
        do = "free some space or point it elsewhere; finished stages are kept"
        raise InputError(f"{path}", expected=expected, found=found, do=do) from error


def _is_artefact(folder: Path) -> bool:
    return folder.is_dir() and folder.suffix == ""  # not a draft or a long stage's scratch folder


def _read(folder: Path) -> Artefact:
    files = [file.stat() for file in folder.iterdir() if file.is_file()]
    place = folder.parent.name, folder.name, sum(s.st_size for s in files)
    written = max((s.st_mtime for s in files), default=folder.stat().st_mtime)
    try:
        meta = json.loads((folder / "meta.json").read_text("utf-8"))
        outputs = {name: output["digest"] for name, output in meta["outputs"].items()}
        about = meta["function"], meta["case"], meta["settings"], outputs, meta["seconds"], meta["peak_mb"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return Artefact(*place, written)
    return Artefact(*place, written, *about)


def _describe(value: object, prefix: str, arrays: dict[str, np.ndarray]) -> object:
    if isinstance(value, np.ndarray):
        arrays[prefix] = np.ascontiguousarray(value)
        return {"array": list(value.shape)}  # safetensors keeps the shape; this tells an array from a number
    if type(value).__name__ in VALUES:
        parts = {f.name: _describe(getattr(value, f.name), f"{prefix}.{f.name}", arrays) for f in fields(value)}
        return {"value": type(value).__name__, "fields": parts}
    if isinstance(value, tuple):
        return {"tuple": list(value)}
    if value is None or isinstance(value, str | int | float | bool):
        return {"plain": value}
    raise TypeError(f"{prefix or 'value'}: {type(value).__name__} cannot be stored")


def _restore(header: dict, prefix: str, arrays: dict[str, np.ndarray]) -> object:
    if "array" in header:
        return arrays[prefix]
    if "value" in header:
        kind = VALUES[header["value"]]
        return kind(**{n: _restore(h, f"{prefix}.{n}", arrays) for n, h in header["fields"].items()})
    if "tuple" in header:
        return tuple(header["tuple"])
    return header["plain"]


def _write(path: Path, data: bytes) -> None:
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(path: Path) -> None:
    if os.name == "posix":  # elsewhere a folder cannot be opened
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
