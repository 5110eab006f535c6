"""FITS files written a few images at a time: memory does not grow with their number."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from amibayes.support.atomic_files import atomic_path

BLOCK = 2880
"""FITS files come in blocks of so many bytes."""


class FitsStream:
    """Image extensions of known shape whose planes may be written in any order.

    Use `FitsStream.create`.
    """

    def __init__(self, stream: BinaryIO, places: dict[str, tuple[int, NDArray[Any]]]) -> None:
        self._stream = stream
        self._places = places

    def write(self, name: str, start: int, planes: NDArray[Any]) -> None:
        """Write consecutive planes of extension ``name`` from plane ``start`` on."""
        offset, plane = self._places[name]
        if planes.shape[1:] != plane.shape:
            raise ValueError(f"{name} has planes of {plane.shape}, not {planes.shape[1:]}")
        self._stream.seek(offset + start * plane.nbytes)
        self._stream.write(_encoded(planes, plane.dtype))

    @classmethod
    @contextmanager
    def create(cls, path: str | Path, hdus: Sequence[Any]) -> Iterator[FitsStream]:
        """Create a file that appears whole when the block succeeds, or not at all.

        Parameters
        ----------
        path : path
            The file.
        hdus : sequence
            Complete HDUs of astropy, and `empty_image` for those to be streamed.

        Raises
        ------
        RunError
            Where the file cannot be written or the disk is full.
        """
        with atomic_path(path) as temporary, temporary.open("wb") as stream:
            places: dict[str, tuple[int, NDArray[Any]]] = {}
            for hdu in hdus:
                if isinstance(hdu, EmptyImage):
                    places[hdu.name] = hdu.reserve(stream)
                else:
                    stream.write(_rendered(hdu))
            yield cls(stream, places)
            stream.flush()


class EmptyImage:
    """An image extension whose data come later.

    Parameters
    ----------
    name : str
        EXTNAME.
    shape : tuple
        Shape of the array; the first axis counts the planes.
    dtype : str
        ``float32``, ``uint8``, ``uint16`` or ``uint32``.
    header : astropy Header, optional
        Further keywords.
    """

    def __init__(
        self, name: str, shape: tuple[int, ...], dtype: str, header: Any | None = None
    ) -> None:
        self.name = name
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self._header = header or fits.Header()

    def reserve(self, stream: BinaryIO) -> tuple[int, NDArray[Any]]:
        """Write the header and leave room; give the place of the data and a plane's form."""
        offset = _has_offset(self.dtype)
        kind = np.dtype(f"i{self.dtype.itemsize}") if offset else self.dtype
        header = fits.ImageHDU(np.zeros((1,) * len(self.shape), kind), name=self.name).header
        for axis, length in enumerate(reversed(self.shape), start=1):
            header[f"NAXIS{axis}"] = length
        if offset:
            header["BSCALE"] = 1
            header["BZERO"] = 1 << (8 * self.dtype.itemsize - 1)
        header.extend(self._header, unique=True)
        stream.write(header.tostring().encode("ascii"))
        start = stream.tell()
        size = int(np.prod(self.shape)) * self.dtype.itemsize
        stream.seek(start + size + (-size) % BLOCK)
        stream.truncate()
        return start, np.empty(self.shape[1:], self.dtype)


def _has_offset(dtype: np.dtype[Any]) -> bool:
    """Tell whether FITS has such numbers only by an offset: unsigned ones of more than a byte."""
    return dtype.kind == "u" and dtype.itemsize > 1


def _encoded(planes: NDArray[Any], dtype: np.dtype[Any]) -> bytes:
    """Bytes of an array as FITS stores it: big-endian, unsigned with an offset."""
    array = planes.astype(dtype, copy=False)
    if _has_offset(dtype):
        bits = 8 * dtype.itemsize
        array = (array ^ dtype.type(1 << (bits - 1))).view(f"i{dtype.itemsize}")
    return array.astype(array.dtype.newbyteorder(">")).tobytes()


def _rendered(hdu: Any) -> bytes:
    """Give the bytes of a complete HDU."""
    import io

    buffer = io.BytesIO()
    hdu.writeto(buffer)
    content = buffer.getvalue()
    if isinstance(hdu, fits.PrimaryHDU):
        return content
    # astropy puts an empty primary HDU before an extension that is written alone
    return content[len(fits.PrimaryHDU().header.tostring()) :]
