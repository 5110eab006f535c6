"""What a file of ramps must hold, and ramps that are read as slopes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from amibayes.cube import header as keys
from amibayes.cube.container import Cube
from amibayes.cube.ramps import RampFile
from amibayes.cube.reference_files import bias_of, linearity_of
from amibayes.cube.timing import timing_of
from amibayes.errors import DataError
from amibayes.units import FloatArray

AXES = "(integration, group, y, x)"
SLOPES = "give the slope images of each integration (calints)"


def refuse_raw(hdus: Any, hdu: Any, source: str) -> None:
    """Refuse ramps that are raw, by the step that comes next, and what is no ramp at all.

    Raises
    ------
    DataError
    """
    names = {h.name for h in hdus}
    # The detector counts in whole numbers; every later step makes floating-point ones.
    raw = len(hdu.shape) == 4 and hdu.header["BITPIX"] > 0 and "GROUPDQ" not in names
    if raw:
        raise DataError(
            "holds raw ramps (uncal): neither linear nor flagged",
            source=source,
            remedy="run jwst's calwebb_detector1 and give its _ramp file, or calwebb_image2 too, "
            "and give its _calints",
        )
    if len(hdu.shape) != 4 or 0 in hdu.shape:
        raise DataError(
            f"holds {len(hdu.shape)}-dimensional data, neither images nor ramps",
            source=source,
            remedy=SLOPES,
        )


def check_ramps(hdus: Any, science: Any, header: Mapping[str, Any], source: str) -> None:
    """Refuse ramps whose axes are not those that the header tells of.

    Raises
    ------
    DataError
    """
    shape = tuple(science.shape)
    if len(shape) == 3:
        model = keys.text(header, "DATAMODL") or ""
        if model == "RampModel" or any(h.name == "GROUPDQ" for h in hdus):
            raise DataError(
                f"holds ramps in the three axes {shape}", source=source, remedy=f"give them {AXES}"
            )
    if len(shape) != 4:
        return
    stated = keys.number(header, "NGROUPS", source)
    if stated is not None and stated != shape[1]:
        raise DataError(
            f"SCI has the axes {shape}, and NGROUPS is {stated:g}",
            source=source,
            remedy=f"order the axes {AXES}, or correct NGROUPS",
        )


def ramp_file(hdus: Any, science: Any, template: Cube, mjd: FloatArray | None) -> RampFile:
    """Ramps that are read as slopes; ``template`` has the unit of the ramps.

    Raises
    ------
    DataError
        Where they have fewer than two groups, or do not say the time between groups.
    """
    header, source = template.header, template.source
    n, groups, *shape = science.shape
    step = _group_time_s(header, source)
    if groups < 2 or step is None or not step > 0.0:
        fault = f"has {groups} group in a ramp" if groups < 2 else "does not say TGROUP"
        raise DataError(f"{fault}: no slopes", source=source, remedy="give slope images (calints)")
    parts = {"SCI": science}
    for name, wanted in (("GROUPDQ", science.shape), ("PIXELDQ", tuple(shape))):
        parts |= _flags(hdus, name, wanted, source)
    in_electrons = template.unit.lower().startswith(("electron", "e-"))
    unit = "electron/s" if in_electrons else "DN/s"
    template = replace(template, unit=unit, notes=template.notes + _cut_ramps(header, source))
    timing, pixels = timing_of(header, groups, step, source), (shape[0], shape[1])
    bias, linearity = bias_of(header, source, pixels), linearity_of(header, source, pixels)
    return RampFile(template, n, parts, mjd, timing, bias, linearity)


def _group_time_s(header: Mapping[str, Any], source: str) -> float | None:
    """Seconds from one group to the next: TGROUP, else the frames of a group and its gap."""
    group, frame = (keys.number(header, key, source) for key in ("TGROUP", "TFRAME"))
    if group is not None or frame is None:
        return group
    count, gap = (keys.number(header, key, source) for key in ("NFRAMES", "GROUPGAP"))
    return frame * ((count or 1.0) + (gap or 0.0))


def _flags(hdus: Any, name: str, wanted: tuple[int, ...], source: str) -> dict[str, Any]:
    """Data quality flags by their name, where the file has them."""
    there = next((h for h in hdus if h.name == name and h.is_image), None)
    if there is None:
        return {}
    if there.shape != wanted:
        raise DataError(f"{name} has the shape {there.shape}, not {wanted}", source=source)
    if there.header["BITPIX"] < 0:
        raise DataError(f"{name} holds floating-point numbers, no flags", source=source)
    return {name: there}


def _cut_ramps(header: Mapping[str, Any], source: str) -> tuple[str, ...]:
    """Say where jwst has flagged the groups that tell of charge migration."""
    if keys.text(header, "S_CHGMIG") != "COMPLETE":
        return ()
    return (
        f"{source}: jwst's charge_migration step has flagged the last groups of bright pixels "
        "(S_CHGMIG), which hence tell less of it; run calwebb_detector1 without that step",
    )
