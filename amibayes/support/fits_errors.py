"""Damaged FITS files: every complaint of the library becomes one line about the file."""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from astropy.io import fits

from amibayes.errors import AmibayesError, DataError

UNREADABLE = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    ArithmeticError,
    AssertionError,
    MemoryError,
    EOFError,
    struct.error,
    zlib.error,
    fits.VerifyError,
)
"""What astropy raises, sooner or later, where headers or data are not what they should be."""

MISTAKES = (TypeError, AttributeError, KeyError, IndexError, AssertionError)
"""Of these, those raised by amibayes itself are its own mistakes and no damage of a file."""

PACKAGE = str(Path(__file__).resolve().parents[1])


def _is_ours(error: BaseException) -> bool:
    """Whether an error was raised by a line of amibayes."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and trace.tb_frame.f_code.co_filename.startswith(PACKAGE)


@contextmanager
def reporting_damage(source: str | Path) -> Iterator[None]:
    """Turn what a library raises over a damaged file into a `DataError`, and hush its warnings.

    Raises
    ------
    DataError
        Naming the file and what the library found.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except AmibayesError:
        raise
    except MemoryError as error:
        raise DataError(
            "needs more memory than there is",
            source=source,
            remedy="free memory, or check the sizes in its header",
        ) from error
    except UNREADABLE as error:
        if isinstance(error, MISTAKES) and _is_ours(error):
            raise
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise DataError(
            f"is a damaged FITS file: {reason}", source=source, remedy="copy or download it again"
        ) from error
