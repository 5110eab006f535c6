"""Stage-3 products in the layout of the jwst package (3.0), with its faults, made of numbers.

The faults are those that METHODS lists, and a genuine file shows: VIS2ERR divided by √N twice,
phase errors not divided by amplitudes, linear means of phases, errors of 0 in ``amimulti-oi``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.instrument import Mask, load_instrument
from amibayes.oifits.products.repairs import with_columns
from amibayes.oifits.tables import OIFits, open_oifits
from amibayes.units import ComplexArray, FloatArray

MASK = load_instrument("niriss", "F480M").mask
WAVELENGTH_M, BAND_M = 4.8195e-6, 2.8516e-7
ROLL_DEG, EXPMID = 37.3, 60000.17

PAIRS, TRIANGLES = MASK.pairs, MASK.triangles


def sky_holes(turned_deg: float = ROLL_DEG, mask: Mask = MASK) -> FloatArray:
    """Holes (7, 2) on the sky, east and north, at some orientation."""
    angle = np.radians(turned_deg)
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(mask.holes_m @ np.array([[-c, s], [s, c]]))


def baselines(turned_deg: float = ROLL_DEG, mask: Mask = MASK) -> FloatArray:
    """(21, 2) baselines u, v."""
    holes = sky_holes(turned_deg, mask)
    return np.asarray(holes[PAIRS[:, 1]] - holes[PAIRS[:, 0]])


def binary(
    contrast: float,
    east_mas: float,
    north_mas: float,
    turned_deg: float = ROLL_DEG,
    mask: Mask = MASK,
) -> Any:
    """Visibilities (21,) of a star with a companion, at one wavelength."""
    mas = np.pi / 180 / 3.6e6
    phase = baselines(turned_deg, mask) @ (np.array([east_mas, north_mas]) * mas) / WAVELENGTH_M
    return (1.0 + contrast * np.exp(-2j * np.pi * phase)) / (1.0 + contrast)


def integrations(
    mean: ComplexArray, sigma: float, n: int, rng: np.random.Generator
) -> ComplexArray:
    """(n, 21) visibilities with noise ``sigma`` in real and imaginary part."""
    noise = rng.normal(size=(2, n, len(mean))) * sigma
    return np.asarray(mean + noise[0] + 1j * noise[1])


class Averages:
    """What the pipeline makes of integrations (n, 21), with its mistakes."""

    def __init__(self, visibility: ComplexArray) -> None:
        n = len(visibility)
        self.n = n
        ij, jk, ik = (visibility[:, k] for k in MASK.triangle_baselines.T)
        self.amplitude, self.phase = np.abs(visibility), np.degrees(np.angle(visibility))
        self.vis2 = self.amplitude**2
        bispectrum = ij * jk * ik.conj()
        self.t3amp, self.t3phi = np.abs(bispectrum), np.degrees(np.angle(bispectrum))

        def scatter(x: Any) -> Any:
            return x.std(axis=0, ddof=1) / np.sqrt(n) if n > 1 else np.full(x.shape[1], np.nan)

        self.visamp, self.visamperr = self.amplitude.mean(axis=0), scatter(self.amplitude)
        self.vis2data = self.vis2.mean(axis=0)
        self.vis2err = 2.0 * self.visamp * self.visamperr / np.sqrt(n)
        self.t3ampm, self.t3amperr = self.t3amp.mean(axis=0), scatter(self.t3amp)
        self.t3phim = self.t3phi.mean(axis=0)
        self.t3phierr = scatter(self.t3phi) * self.t3ampm
        self.visphi, self.visphierr = self.phase.mean(axis=0), scatter(self.phase) * self.visamp


def _data(name: str, columns: dict[str, Any], uv: dict[str, Any], stations: Any) -> Any:
    n = len(stations)
    same = {"TARGET_ID": ("I", 1), "TIME": ("D", 0.0), "MJD": ("D", np.floor(EXPMID))}
    same["INT_TIME"] = ("D", 0.7544)
    built = [fits.Column(k, f, array=np.full(n, v)) for k, (f, v) in same.items()]
    for key, value in (columns | uv).items():
        width = value.shape[1] if value.ndim == 2 else 1
        built.append(fits.Column(key, f"{width}D" if width > 1 else "D", array=value))
    built.append(fits.Column("STA_INDEX", f"{stations.shape[1]}I", array=stations + 1))
    built.append(fits.Column("FLAG", "L", array=np.zeros(n, bool)))
    hdu = fits.BinTableHDU.from_columns(built, name=name)
    for key, value in (("ARRNAME", "jwst_ami"), ("INSNAME", "NIRISS"), ("OI_REVN", 2)):
        hdu.header[key] = value
    hdu.header["DATE-OBS"] = "2023-02-25"
    return hdu


def _frame(kind: str, n: int, keywords: dict[str, Any], turned_deg: float) -> tuple[Any, ...]:
    primary = fits.PrimaryHDU()
    primary.header.update(
        {
            "DATAMODL": "AmiOIModel", "TELESCOP": "JWST", "INSTRUME": "NIRISS", "FILTER": "F480M",
            "PUPIL": "NRM", "EXP_TYPE": "NIS_AMI", "TARGPROP": "TARGET", "ROLL_REF": turned_deg,
            "V3I_YANG": -0.5669, "VPARITY": -1, "NINTS": n, "EFFINTTM": 0.7544,
            "EFFEXPTM": 0.7544 * n, "EXPSTART": EXPMID - 0.001, "EXPMID": EXPMID,
            "EXPEND": EXPMID + 0.001, "CONTENT": "OIFITS2", "CAL_VER": "3.0.0", "MU_RA": 0.029,
        }
    )  # fmt: skip
    primary.header.update(keywords)
    if kind == "aminorm-oi":
        primary.header["S_AMINOR"] = "COMPLETE"
    holes = sky_holes(turned_deg)
    pistons = ["PISTON_T", "PISTON_C"] if kind == "aminorm-oi" else ["PISTONS"]
    array = [
        fits.Column("TEL_NAME", "16A", array=[f"A{k}" for k in range(1, 8)]),
        fits.Column("STA_NAME", "16A", array=[f"A{k}" for k in range(1, 8)]),
        fits.Column("STA_INDEX", "I", array=np.arange(1, 8)),
        fits.Column("DIAMETER", "E", array=np.zeros(7)),
        fits.Column("STAXYZ", "3D", array=np.c_[MASK.holes_m, np.zeros(7)]),
        fits.Column("FOV", "D", array=np.full(7, 4.875)),
        fits.Column("FOVTYPE", "6A", array=["RADIUS"] * 7),
        fits.Column("CTRS_EQT", "2D", array=-holes[:, ::-1]),
        *(fits.Column(p, "D", array=np.zeros(7)) for p in pistons),
    ]
    target = [
        fits.Column("TARGET_ID", "I", array=[1]),
        fits.Column("TARGET", "16A", array=["TARGET"]),
        fits.Column("RAEP0", "D", array=[82.1874]),
        fits.Column("DECEP0", "D", array=[-65.4477]),
        fits.Column("PMRA", "D", array=[0.029]),
    ]
    hdu = fits.BinTableHDU.from_columns
    stations = hdu(array, name="OI_ARRAY")
    stations.header["ARRNAME"] = "jwst_ami"
    wave = hdu(
        [
            fits.Column("EFF_WAVE", "E", array=[WAVELENGTH_M]),
            fits.Column("EFF_BAND", "E", array=[BAND_M]),
        ],
        name="OI_WAVELENGTH",
    )
    wave.header["INSNAME"] = "NIRISS"
    return primary, stations, hdu(target, name="OI_TARGET"), wave


def _log(mx: float, my: float, sx: float, sy: float) -> Any:
    """What the pipeline keeps of its log, its lines broken as in its files."""
    text = (
        f"cal_logs:\n    ['2026-11-22T04:36:14.213\n      - jwst.ami.ami_analyze - INFO - Using "
        f"affine transform with parameters:', \"2026-11-22T04:36:14.213\n      - "
        f'jwst.ami.ami_analyze - INFO - \\tmx={mx:.6f}\\tmy={my:.6f}", "2026-11-22T04:36:14.214\n'
        f'      - jwst.ami.ami_analyze - INFO - \\tsx={sx:.6f}\\tsy={sy:.6f}", '
        f'"2026-11-22T04:36:14.214\n      - jwst.ami.ami_analyze - INFO - \\trotradccw=None"]\n'
    )
    content = np.frombuffer(text.encode(), np.uint8)[None]
    column = fits.Column("ASDF_METADATA", f"{content.size}B", array=content)
    return fits.BinTableHDU.from_columns([column], name="ASDF")


def columns_of(
    kind: str, visibility: ComplexArray, calibrator: ComplexArray | None = None
) -> dict[str, dict[str, Any]]:
    """Values and errors, by table, of integrations (n, 21), and of a calibrator's."""
    a = Averages(visibility)
    if kind == "amimulti-oi":
        vis2 = {"VIS2DATA": a.vis2.T, "VIS2ERR": 0 * a.vis2.T}
        vis = {"VISAMP": a.amplitude.T, "VISAMPERR": 0 * a.vis2.T}
        vis |= {"VISPHI": a.phase.T, "VISPHIERR": 0 * a.vis2.T}
        t3 = {"T3AMP": a.t3amp.T, "T3AMPERR": 0 * a.t3amp.T}
        t3 |= {"T3PHI": a.t3phi.T, "T3PHIERR": 0 * a.t3amp.T}
    else:
        vis2 = {"VIS2DATA": a.vis2data, "VIS2ERR": a.vis2err}
        vis = {"VISAMP": a.visamp, "VISAMPERR": a.visamperr}
        vis |= {"VISPHI": a.visphi, "VISPHIERR": a.visphierr}
        t3 = {"T3AMP": a.t3ampm, "T3AMPERR": a.t3amperr, "T3PHI": a.t3phim, "T3PHIERR": a.t3phierr}
    if calibrator is not None:
        c = Averages(calibrator)
        # The errors of target and calibrator are exchanged.
        wrong = np.hypot(c.vis2err / c.vis2data, a.vis2err * a.vis2data / c.vis2data**2)
        vis2 = {"VIS2DATA": a.vis2data / c.vis2data, "VIS2ERR": wrong}
        amplitude = a.visamp / c.visamp
        sigma = amplitude * np.hypot(a.visamperr / a.visamp, c.visamperr / c.visamp)
        vis |= {"VISAMP": amplitude, "VISAMPERR": sigma}
        t3 |= {"T3PHI": a.t3phim - c.t3phim, "T3PHIERR": np.hypot(a.t3phierr, c.t3phierr)}
    return {"OI_VIS2": vis2, "OI_VIS": vis, "OI_T3": t3}


def product(
    kind: str,
    visibility: ComplexArray,
    calibrator: ComplexArray | None = None,
    *,
    turned_deg: float = ROLL_DEG,
    affine: tuple[float, float, float, float] | None = (1.0, 1.0, 0.0, 0.0),
    **keywords: Any,
) -> Any:
    """HDUs of a product of integrations (n, 21), and of a calibrator's for ``aminorm-oi``.

    ``affine`` (mx, my, sx, sy) is in the log that it keeps; None for no log.
    """
    values = columns_of(kind, visibility, calibrator)
    uv, holes = baselines(turned_deg), sky_holes(turned_deg)
    two = {"UCOORD": uv[:, 0], "VCOORD": uv[:, 1]}
    first, second = (holes[TRIANGLES[:, k + 1]] - holes[TRIANGLES[:, k]] for k in (0, 1))
    three = {"U1COORD": first[:, 0], "V1COORD": first[:, 1]}
    three |= {"U2COORD": second[:, 0], "V2COORD": second[:, 1]}
    primary, stations, target, wave = _frame(kind, len(visibility), keywords, turned_deg)
    quads = {"Q4AMP": np.ones(35), "Q4PHI": np.zeros(35)}
    return fits.HDUList(
        [
            primary, stations, target,
            _data("OI_T3", values["OI_T3"], three, TRIANGLES),
            _data("OI_VIS", values["OI_VIS"], two, PAIRS),
            _data("OI_VIS2", values["OI_VIS2"], two, PAIRS),
            _data("OI_Q4", quads, {}, np.tile(np.arange(4), (35, 1))),
            wave,
            *([] if affine is None else [_log(*affine)]),
        ]
    )  # fmt: skip


def with_other_numbers(oifits: OIFits, values: dict[str, dict[str, Any]]) -> OIFits:
    """A file of the same layout with other `columns_of`, without writing it."""
    tables = tuple(with_columns(t, values.get(t.name, {})) for t in oifits.tables)
    return replace(oifits, tables=tables)


def write_product(path: Path, *arguments: Any, **keywords: Any) -> Path:
    """Write a `product`."""
    product(*arguments, **keywords).writeto(path, overwrite=True)
    return path


def as_oifits(path: Path, *arguments: Any, **keywords: Any) -> OIFits:
    """A `product` as `open_oifits` reads it."""
    return open_oifits(write_product(path, *arguments, **keywords))
