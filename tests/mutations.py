"""Files damaged at random: bytes, headers, shapes, types and values."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy.io import fits

BLOCK = 2880
ODD_VALUES = ("NaN", "-1", "0", "1e308", "''", "'\\x00'", "T", "'a'", "99999999", "1E", "-99999")
ODD_NUMBERS = (np.nan, np.inf, -np.inf, 1e300, -1e300, 0.0, -1.0, 1e8, 1e-300)


def flip_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    """Change between one and a hundred bytes, anywhere or in the headers only."""
    data = bytearray(content)
    last = len(data) if rng.random() < 0.5 else min(len(data), 4 * BLOCK)
    for place in rng.integers(0, last, int(10 ** rng.uniform(0, 2))):
        data[place] = rng.integers(0, 256)
    return bytes(data)


def truncate(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: int(rng.integers(0, len(content)))]


def move_blocks(content: bytes, rng: np.random.Generator) -> bytes:
    """Drop, repeat or swap blocks of the length that FITS counts in."""
    blocks = [content[i : i + BLOCK] for i in range(0, len(content), BLOCK)]
    one, other = rng.integers(0, len(blocks), 2)
    what = rng.integers(0, 3)
    if what == 0:
        del blocks[one]
    elif what == 1:
        blocks.insert(one, blocks[other])
    else:
        blocks[one], blocks[other] = blocks[other], blocks[one]
    return b"".join(blocks)


def edit_card(content: bytes, rng: np.random.Generator) -> bytes:
    """Give some header cards another value, or another name."""
    data = bytearray(content)
    cards = [m.start() for m in re.finditer(rb"[A-Z0-9_-]{1,8} *= ", content) if not m.start() % 80]
    for start in rng.choice(cards, min(len(cards), int(rng.integers(1, 4))), replace=False):
        if rng.random() < 0.2:
            data[start : start + 8] = b"XXXXXXXX"
            continue
        value = str(rng.choice(ODD_VALUES)).encode("ascii").ljust(70)
        data[start + 10 : start + 80] = value[:70]
    return bytes(data)


def odd_values(content: bytes, rng: np.random.Generator) -> bytes:
    """Put numbers that cannot be into a few places of the tables and images."""

    def spoil(array: np.ndarray) -> np.ndarray:
        if array.dtype.kind not in "fiu" or not array.size:
            return array
        copy = array.copy()
        flat = copy.reshape(-1)
        share = rng.choice([1, max(1, flat.size // 10), flat.size])
        places = rng.choice(flat.size, share, replace=False)
        with np.errstate(all="ignore"):
            flat[places] = np.array(rng.choice(ODD_NUMBERS)).astype(copy.dtype)
        return copy

    return _rebuilt(content, rng, spoil)


def other_types(content: bytes, rng: np.random.Generator) -> bytes:
    """Change the type or the shape of a column or an image."""

    def turn(array: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            if array.dtype.kind in "fiu" and rng.random() < 0.5:
                return array.astype(rng.choice(["int16", "float32", "int64"]))
        if array.ndim and len(array) > 1:
            return array[: int(rng.integers(0, len(array)))]
        return array[None]

    return _rebuilt(content, rng, turn)


def _rebuilt(
    content: bytes, rng: np.random.Generator, change: Callable[[np.ndarray], np.ndarray]
) -> bytes:
    """Apply a change to one column or image and write the file again."""
    with fits.open(io.BytesIO(content), memmap=False) as hdus:
        usable = [k for k, h in enumerate(hdus) if h.data is not None]
        hdu = hdus[int(rng.choice(usable))]
        if isinstance(hdu, fits.BinTableHDU):
            new = _changed_table(hdu, str(rng.choice(hdu.columns.names)), change, rng)
        else:
            new = type(hdu)(change(np.asarray(hdu.data)), hdu.header)
        parts = [new if h is hdu else h for h in hdus]
        if rng.random() < 0.1:
            parts = [h for h in parts if h is not new] or parts
        stream = io.BytesIO()
        fits.HDUList(parts).writeto(stream, output_verify="ignore")
    return stream.getvalue()


def _changed_table(
    hdu: fits.BinTableHDU,
    name: str,
    change: Callable[[np.ndarray], np.ndarray],
    rng: np.random.Generator,
) -> fits.BinTableHDU:
    if rng.random() < 0.15:
        kept = [c for c in hdu.columns if c.name != name]
        return fits.BinTableHDU.from_columns(kept, hdu.header)
    rows = {c.name: np.asarray(hdu.data[c.name]) for c in hdu.columns}
    rows[name] = change(rows[name])
    n = min(len(v) for v in rows.values())
    columns = [_column(key, values[:n]) for key, values in rows.items()]
    return fits.BinTableHDU.from_columns(columns, hdu.header)


def _column(name: str, values: np.ndarray) -> fits.Column:
    codes = {"f4": "E", "f8": "D", "i2": "I", "i4": "J", "i8": "K", "b1": "L"}
    if values.dtype.kind in "SU":
        width = max(1, values.dtype.itemsize // (4 if values.dtype.kind == "U" else 1))
        return fits.Column(name, f"{width}A", array=values)
    code = codes[values.dtype.newbyteorder("=").str[1:]]
    repeat = int(np.prod(values.shape[1:])) if values.ndim > 1 else 1
    dim = f"({','.join(map(str, values.shape[:0:-1]))})" if values.ndim > 2 else None
    return fits.Column(name, f"{repeat}{code}", array=values, dim=dim)


def edit_text(content: bytes, rng: np.random.Generator) -> bytes:
    """Damage a text file: values, keys, lines, bytes."""
    lines = content.decode().splitlines()
    for _ in range(int(rng.integers(1, 4))):
        k = int(rng.integers(0, len(lines)))
        what = rng.integers(0, 5)
        if what == 0:
            del lines[k]
        elif what == 1:
            lines.insert(k, lines[int(rng.integers(0, len(lines)))])
        elif what == 2 and "=" in lines[k]:
            odd = ("nan", "-1", "inf", "1e300", '""', "[]", "{}", "true", '"../x"', "0", "[1, -2]")
            lines[k] = f"{lines[k].split('=')[0]}= {rng.choice(odd)}"
        elif what == 3 and "=" in lines[k]:
            lines[k] = f"x{lines[k]}"
        else:
            lines[k] = lines[k][: int(rng.integers(0, len(lines[k]) + 1))]
        lines = lines or [""]
    text = "\n".join(lines).encode()
    return flip_bytes(text, rng) if rng.random() < 0.1 and text else text


FITS_MUTATIONS = (flip_bytes, truncate, move_blocks, edit_card, odd_values, other_types)


def mutate(path: Path, rng: np.random.Generator) -> tuple[str, bytes]:
    """Damage the content of a file; the name of what was done comes with it."""
    content = path.read_bytes()
    if path.suffix in (".toml", ".ecsv", ".csv"):
        return "edit_text", edit_text(content, rng)
    mutation = FITS_MUTATIONS[int(rng.integers(0, len(FITS_MUTATIONS)))]
    return mutation.__name__, mutation(content, rng)
