"""A joint fit in ``report.html``: bands, motion, and each file by itself."""

from __future__ import annotations

from typing import Any

from amibayes.models.bands import band_name
from amibayes.report.page import Column, Table
from amibayes.report.words import NONE, fixed, measured, plain
from amibayes.support.atomic_files import short_names

Json = dict[str, Any]

RESIDUALS = {
    "chi2r_single_vis2": "V² without",
    "chi2r_vis2": "V² with",
    "chi2r_single_closure_phase": "Closure phase without",
    "chi2r_closure_phase": "Closure phase with",
}


def joint_tables(content: Json) -> tuple[Table, ...]:
    """Contrasts of the bands, rates, and reduced χ² of the files; empty for a single data set."""
    fit = content["fit"]
    return (*_bands(fit), *_motion(fit), *_files(content))


def _bands(fit: Json) -> tuple[Table, ...]:
    """Contrast and magnitude difference of every band."""
    if "contrasts" not in fit:
        return ()
    rows = tuple(
        (
            band_name(band["band"]),
            fixed(band["wavelength_um"], 3),
            measured(band["contrast"], band["errors"]["contrast"]),
            measured(band["delta_mag"], band["errors"]["delta_mag"]),
        )
        for band in fit["contrasts"]
    )
    kind = "each has its own" if fit["contrast_kind"] == "per-filter" else "one for all of them"
    columns = (
        Column("Band", "text"),
        Column("Wavelength (µm)"),
        Column("Contrast (flux ratio)"),
        Column("Magnitude difference"),
    )
    return (Table(f"Contrasts of the bands, {kind}; errors are 1σ", columns, rows),)


def _motion(fit: Json) -> tuple[Table, ...]:
    """Rates along east and north."""
    if "reference_mjd" not in fit:
        return ()
    rows = tuple(
        (name, measured(fit[key], fit["errors"].get(key)), "mas/yr")
        for name, key in (("East", "east_rate_mas_yr"), ("North", "north_rate_mas_yr"))
    )
    caption = (
        f"Linear motion; the position above is that of MJD {fixed(fit['reference_mjd'], 2)}, rates "
        f"were tried up to {plain(fit['fastest_mas_yr'])} mas/yr"
    )
    return (Table(caption, (Column("", "text"), Column("Rate"), Column("Unit", "text")), rows),)


def _files(content: Json) -> tuple[Table, ...]:
    """Reduced χ² of every file, and its noise where files have noise of their own."""
    if "residuals" not in content:
        return ()
    extra = {f["path"]: f for f in content["noise"].get("files", ())}
    columns = [Column("File", "text"), *(Column(title) for title in RESIDUALS.values())]
    if extra:
        columns += [Column("Added to V²"), Column("Added to closure phase (°)")]
    rows = []
    names = short_names([f["path"] for f in content["residuals"]])
    for name, f in zip(names, content["residuals"], strict=True):
        values = [NONE if f[key] is None else fixed(f[key], 2) for key in RESIDUALS]
        if extra:
            own = extra[f["path"]]
            values += [plain(own[key], 2) for key in ("extra_vis2", "extra_closure_phase_deg")]
        rows.append((name, *values))
    caption = "Reduced χ² of each file without and with the companion" + (
        ", and the noise added to its errors" if extra else ""
    )
    return (Table(caption, tuple(columns), tuple(rows)),)
