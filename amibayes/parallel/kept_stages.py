"""Finished stages of a run, kept so that a run that was cut off goes on behind them.

What a stage made is pickled. A pickle can name any function of any module and have it called, and
folders of results travel: only classes of amibayes, and what arrays are made of, are read back.
A file that is damaged, of another version or names anything else counts as no file, and the stage
is done again.
"""

from __future__ import annotations

import hashlib
import pickle
from io import BytesIO
from pathlib import Path
from typing import Any

from amibayes.support.atomic_files import atomic_path

DIGEST = 32
"""Bytes of a SHA-256, which go before the pickle: files are not forced to the disk one by one,
which would cost more than many a stage, so that a power cut may leave a part of one."""

ARRAYS = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy.core.numeric", "_frombuffer"),
    ("scipy.sparse._csr", "csr_array"),
    ("scipy.sparse._csc", "csc_array"),
    ("scipy.sparse._coo", "coo_array"),
    ("pathlib", "PosixPath"),
    ("pathlib", "WindowsPath"),
    ("builtins", "set"),
    ("builtins", "frozenset"),
    ("builtins", "slice"),
    ("builtins", "complex"),
    ("collections", "OrderedDict"),
    ("copyreg", "_reconstructor"),
    ("builtins", "object"),
}
"""What a pickle may name beside classes of amibayes."""


OPENING_FILES = (["parallel"], ["cli"], ["support"])
"""Packages whose classes open and remove files, and start processes."""


class _OnlyOurs(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Find a class of amibayes, or one of `ARRAYS`."""
        package, *inner = module.split(".")
        ours = package == "amibayes" and inner[:1] not in OPENING_FILES and "." not in name
        if not ours and (module, name) not in ARRAYS:
            raise pickle.UnpicklingError(f"{module}.{name} is not read back")
        found = super().find_class(module, name)
        if ours and not isinstance(found, type):
            raise pickle.UnpicklingError(f"{module}.{name} is no class")
        return found


def write_stage(path: Path, result: Any) -> None:
    """Keep what a stage made, whole or not at all."""
    content = pickle.dumps(result)
    with atomic_path(path, lasting=False) as temporary:
        temporary.write_bytes(hashlib.sha256(content).digest() + content)


def read_stage(path: Path) -> Any | None:
    """Read what a stage made; None where it has to be done."""
    try:
        whole = path.read_bytes()
    except OSError:
        return None
    if hashlib.sha256(whole[DIGEST:]).digest() != whole[:DIGEST]:
        return None
    try:
        return _OnlyOurs(BytesIO(whole[DIGEST:])).load()
    # What a class that has changed since makes of the old state can be any error.
    except Exception:  # noqa: BLE001 - the stage is then done again
        return None
