"""Pickle files that carry numbers only: what would call anything but numpy's own array builders is refused unread."""

from __future__ import annotations

import io
import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np

from tasks.datasets import validate
from tasks.errors import InputError

PLAIN = "a pickle of plain numpy arrays, dicts, lists, texts and numbers"
CONVERT = "where you trust the file, load it and write numpy.savez(FILE.npz, pose=…, shape=…, vertices=…, faces=…)"
LFS = b"version https://git-lfs"  # what a clone without Git LFS has in place of a large file


class _Refused(Exception):
    """Something in a pickle that is no plain data."""


def read_pickle(path: Path) -> object:
    """The content of a pickle file. Raises InputError for one that names any class or function but those that numpy's
    plain arrays are made of, for arrays of objects, and for damaged files."""
    data = validate.read_bytes(path, expected=PLAIN)
    if data.startswith(LFS):
        raise InputError(str(path), expected=PLAIN, found="a pointer of Git LFS", do="fetch it with git lfs pull")
    try:
        content = _Plain(io.BytesIO(data), encoding="latin1").load()
    except _Refused as refused:
        raise InputError(str(path), expected=PLAIN, found=str(refused), do=CONVERT) from None
    except Exception as error:  # a damaged pickle can trip over anything
        found = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
        raise InputError(str(path), expected=PLAIN, found=found, do="make or download it again") from None
    _check_numbers(path, content)
    return content


class _Plain(pickle.Unpickler):
    """Knows the names in ``_KNOWN`` and no others."""

    def find_class(self, module: str, name: str) -> object:
        if (module, name) not in _KNOWN:
            raise _Refused(f"{module}.{name}, which is never loaded")
        return _KNOWN[module, name]

    def persistent_load(self, pid: object) -> object:
        raise _Refused("a reference to something outside the file")


def _reconstruct(kind: type, shape: tuple, dtype: object) -> np.ndarray:
    return np.ndarray.__new__(np.ndarray, shape, dtype)


def _scalar(dtype: np.dtype, data: bytes) -> object:
    if dtype.hasobject:
        raise _Refused("an object in a numpy scalar, which is never loaded")
    return np.frombuffer(data, dtype)[0]


def _from_buffer(data: bytes, dtype: np.dtype, shape: tuple, order: str) -> np.ndarray:
    return np.frombuffer(data, dtype).reshape(shape, order=order)


def _encode(text: str, encoding: str) -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise _Refused(f"text in {encoding}")
    return text.encode("latin1")


_KNOWN = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): OrderedDict,
}
for _core in ("numpy.core", "numpy._core"):  # the old and the new home of the same functions
    _KNOWN[f"{_core}.multiarray", "_reconstruct"] = _reconstruct
    _KNOWN[f"{_core}.multiarray", "scalar"] = _scalar
    _KNOWN[f"{_core}.numeric", "_frombuffer"] = _from_buffer


def _check_numbers(path: Path, content: object) -> None:
    if isinstance(content, np.ndarray) and content.dtype.hasobject:
        raise InputError(str(path), expected=PLAIN, found="an array of Python objects", do=CONVERT)
    if isinstance(content, dict):
        content = list(content.values())
    if isinstance(content, list | tuple):
        for entry in content:
            _check_numbers(path, entry)
