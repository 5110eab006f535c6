"""Which files belong together: exposures of one star, and cubes that see one mask."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from amibayes.cube import Cube
from amibayes.cube.source import Images, opened
from amibayes.extraction.charge import CubeMigration
from amibayes.extraction.mask_map import MapEstimate, MaskMap, combined
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.preparation import map_estimate, maps_mask
from amibayes.extraction.table import target_of
from amibayes.instrument import Distortion

SAME_PIXEL = 1e-4
"""Pixel scales of one detector agree to this: a WCS is fitted anew for every exposure."""

_Item = TypeVar("_Item")


def exposures(
    items: Sequence[_Item], template: Callable[[_Item], Cube], *, one_star: bool
) -> list[list[_Item]]:
    """Put together what shows one star through one filter at one orientation.

    Dithers of a visit differ in ROLL_REF by arcseconds, segments of an exposure in nothing.
    Those without a name are of one star, or each of another. Every group is in order of time.
    """
    groups: list[list[_Item]] = []
    for item in items:
        found = next(
            (g for g in groups if _alike(template(g[0]), template(item), one_star=one_star)), None
        )
        if found is None:
            groups.append([item])
        else:
            found.append(item)
    return [sorted(group, key=lambda item: _start(template(item))) for group in groups]


def _alike(one: Cube, other: Cube, *, one_star: bool) -> bool:
    names = (target_of(one).casefold(), target_of(other).casefold())
    if names[0] != names[1] or not (names[0] or one_star):
        return False
    return same_optics(one, other) and one.orientation.is_like(other.orientation)


def same_optics(one: Cube, other: Cube) -> bool:
    """Whether two cubes are of one instrument, filter and pixel scale."""
    a, b = ((c.instrument.upper(), c.filter.upper()) for c in (one, other))
    return a == b and abs(one.pixel_scale_rad / other.pixel_scale_rad - 1.0) < SAME_PIXEL


def _start(template: Cube) -> tuple[float, float]:
    """Time, and first integration of a segment; files that do not say keep their order."""
    numbers = (template.header.get(key) for key in ("EXPSTART", "INTSTART"))
    begin, first = (float(n) if isinstance(n, int | float) else 0.0 for n in numbers)
    return begin, first


def visit_maps(
    cubes: Sequence[Images],
    options: ExtractOptions,
    header: Mapping[str, Any],
    charges: Sequence[CubeMigration] | None = None,
) -> list[MaskMap | None]:
    """Find one map of the mask for all cubes of an instrument and filter.

    Parameters
    ----------
    cubes : sequence of Cube, path or Source
        Of targets and calibrators: single stars tell the map best.
    options : ExtractOptions
    header : mapping
        As for `amibayes.extraction.extract`.
    charges : sequence of CubeMigration, optional
        What is taken out of each cube first; nothing by default.

    Returns
    -------
    list of MaskMap or None
        None where the pixels are not known, or the geometry is to be as stated.
    """
    charges = [CubeMigration()] * len(cubes) if charges is None else charges
    found = [
        _estimate(cube, options, header, charge)
        for cube, charge in zip(cubes, charges, strict=True)
    ]
    maps: list[MaskMap | None] = []
    for own in found:
        if own is None:
            maps.append(None)
            continue
        alike = [f for f in found if f is not None and same_optics(f[0], own[0])]
        maps.append(combined([estimate for _, estimate, _ in alike], own[2]))
    return maps


def _estimate(
    cube: Images, options: ExtractOptions, header: Mapping[str, Any], charge: CubeMigration
) -> tuple[Cube, MapEstimate | None, Distortion] | None:
    with opened(cube, **header) as raw:
        if not maps_mask(raw, options):
            return None
        file = charge.applied(raw)
        return (file.template, *map_estimate(file, options))
