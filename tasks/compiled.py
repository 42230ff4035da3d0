"""Where numba keeps what it compiled.

numba takes a kernel from its cache as long as the kernel's own file is unchanged. The kernels of other files that it
calls are compiled into it, so a change of those would go unnoticed: a wrong result under the right key. Here every
state of the sources has a folder of its own.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path


def keep_kernels_by_source() -> None:
    """Has numba keep the kernels in a folder named after all files that have some. ``NUMBA_CACHE_DIR``, where it is
    set, stays; folders of sources that are gone are deleted; where the folder cannot be made numba takes its own."""
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    root = Path(__file__).resolve().parent
    text = hashlib.sha256()
    for content in (file.read_bytes() for file in sorted(root.rglob("*.py"))):
        if b"njit" in content:
            text.update(content)
    folder = root / "__pycache__" / f"kernels-{text.hexdigest()[:16]}"
    if not folder.exists():
        for old in folder.parent.glob("kernels-*"):
            shutil.rmtree(old, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
