"""Files of a reconstruction: FITS image with celestial coordinates, and JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.imaging import ReconstructedImage
from amibayes.pipeline.imaging import ImagingReport
from amibayes.report.common import inputs_json
from amibayes.support.atomic_files import atomic_path
from amibayes.units import FloatArray, position_angle_deg, separation


def imaging_json(report: ImagingReport, request: str) -> dict[str, Any]:
    """Content of ``image.json``."""
    from amibayes import __version__

    image = report.image
    return {
        "amibayes": __version__,
        "request": request,
        "seed": report.options.search.seed,
        "inputs": inputs_json(report.targets, report.calibrators),
        "purpose": "for looking: measure with search or its --models",
        "data": {
            "n_vis2": image.n_vis2,
            "n_closure_phases": image.n_phases,
            "n_independent": image.n_independent,
            "covariance": image.observables.covariance_kind,
        },
        "regulariser": image.regulariser,
        "weight": image.weight,
        "cross_validation": [
            {"weight": float(w), "chi2_per_datum": float(s), "error": float(e)}
            for w, s, e in zip(image.weights, image.scores, image.score_errors, strict=True)
        ],
        "pixel_mas": image.grid.pixel_mas,
        "n_pixels": image.grid.n,
        "beam_mas": image.beam_mas,
        "star": image.star,
        "diameter_mas": image.diameter_mas,
        "diameter_free": image.diameter_free,
        "flux": image.flux,
        "flux_beside_star": image.beside_star,
        "brightest": dict(zip(("east_mas", "north_mas", "flux"), image.brightest, strict=True)),
        "chi2": image.chi2,
        "p_fit": image.p_fit,
        "chi2_star": _number(image.chi2_star),
        "chi2_vis2": _number(image.chi2_vis2),
        "chi2_closure_phase": _number(image.chi2_phase),
        "largest_back_projected_sigma": float(np.abs(image.back_projected).max()),
        "warnings": list(report.warnings),
        "timing_s": report.timing_s,
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def imaging_summary(content: dict[str, Any], folder: Path) -> list[str]:
    """Sum the result up in at most 20 lines."""
    data = content["data"]
    around = f"{_light(content)}{_disc(content)}" if content["star"] else "no star apart"
    tried = content["cross_validation"]
    chosen = "given" if not tried else "by cross-validation"
    lines = [
        "image       for looking: it measures nothing, and small structure may be noise",
        f"data        {data['n_vis2']} V2, {data['n_closure_phases']} phases, "
        f"{data['n_independent']} independent ({data['covariance']} covariance)",
        f"pixels      {content['n_pixels']} x {content['n_pixels']} of {content['pixel_mas']:.4g} "
        f"mas, beam {content['beam_mas']:.4g} mas",
        f"prior       {content['regulariser']}, weight {content['weight']:.3g} ({chosen})",
        f"light       {around}",
        *([_brightest(content)] if content["flux"] > 0.0 else []),
        f"chi2        {content['chi2']:.1f} of {data['n_independent']} numbers"
        + ("" if content["chi2_star"] is None else f" (star alone {content['chi2_star']:.1f})"),
    ]
    if tried:
        best = min(t["chi2_per_datum"] for t in tried)
        lines.append(f"left out    chi2 {best:.2f} per datum that the image was not made of")
    lines += [f"WARNING     {w}" for w in content["warnings"][: 18 - len(lines)]]
    return [*lines, f"written to  {folder}"]


def _brightest(content: dict[str, Any]) -> str:
    """Light at the brightest place, which is less than that of the image."""
    found = content["brightest"]
    east, north = found["east_mas"], found["north_mas"]
    where = f"{separation(east, north):.4g} mas, PA {position_angle_deg(east, north):.0f} deg"
    return (
        f"brightest   {found['flux']:.3g} within λ/2B of {where}; the rest is spread over the "
        "field, as noise is too"
    )


TOLD_APART = 0.01
"""Share of an image's light beside the star from which on it is told apart from the rest."""


def _light(content: dict[str, Any]) -> str:
    """Flux of the image; what may be the star's own by itself."""
    flux, beside = content["flux"], content["flux_beside_star"]
    if beside <= TOLD_APART * flux:
        return f"{flux:.3g} of the star's flux"
    return (
        f"{flux - beside:.3g} of the star's flux, and {beside:.2g} within λ/4B of the star, which "
        "may be its own"
    )


def _disc(content: dict[str, Any]) -> str:
    """The star's diameter in words, where it has one."""
    fitted = " (fitted)" if content["diameter_free"] else ""
    has_disc = fitted or content["diameter_mas"]
    return f", a disc of {content['diameter_mas']:.3g} mas{fitted}" if has_disc else ""


def save_image_fits(path: str | Path, image: ReconstructedImage) -> None:
    """Write the image, east to the left, with celestial coordinates where they are known.

    The primary HDU is the image (star's flux = 1, without the star), then ``CONVOLVED`` with a
    Gaussian of λ/2B, ``DIRTY``, ``BEAM`` (dirty) and ``RESIDUAL`` (projected back, σ).
    """
    header = _sky_header(image)
    others = {
        "CONVOLVED": image.convolved(),
        "DIRTY": image.dirty_image(),
        "BEAM": image.dirty_beam(),
        "RESIDUAL": image.back_projected,
    }
    hdus: list[Any] = [fits.PrimaryHDU(_east_left(image.light), header)]
    hdus += [fits.ImageHDU(_east_left(v), header, name=name) for name, v in others.items()]
    with atomic_path(path) as temporary:
        fits.HDUList(hdus).writeto(temporary, overwrite=True)


def _east_left(values: FloatArray) -> FloatArray:
    return np.ascontiguousarray(values[:, ::-1])


def _sky_header(image: ReconstructedImage) -> fits.Header:
    setup = image.observables.setups[0]
    ra, dec = setup.right_ascension_deg, setup.declination_deg
    header = fits.Header()
    header["OBJECT"] = setup.target
    header["BUNIT"] = ("STAR" if image.star else "TOTAL", "flux of the star is 1")
    header["STAR"] = (image.star, "a star stands in the middle beside the image")
    header["REGUL"] = (image.regulariser, "regulariser")
    header["WEIGHT"] = (image.weight, "of the regulariser")
    header["BMAJ"] = header["BMIN"] = image.beam_mas / 3.6e6
    header["BPA"] = 0.0
    known = bool(ra or dec)
    step = image.grid.pixel_mas / (3.6e6 if known else 1.0)
    axes = ("RA---TAN", "DEC--TAN") if known else ("EAST", "NORTH")
    if known:
        header["RADESYS"] = "ICRS"
    for i, sign in [(0, -1.0), (1, 1.0)]:
        header[f"CTYPE{i + 1}"] = axes[i]
        header[f"CUNIT{i + 1}"] = "deg" if known else "mas"
        header[f"CRPIX{i + 1}"] = (image.grid.n // 2 + 1.0, "the star")
        header[f"CRVAL{i + 1}"] = (ra, dec)[i] if known else 0.0
        header[f"CDELT{i + 1}"] = sign * step
    return header
