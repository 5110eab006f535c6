"""Results as xarray data sets: arrays with named axes, coordinates and units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from amibayes.support.optional import optional_package
from amibayes.units import FloatArray

UNITS = {"mas": "mas", "deg": "deg", "rad": "rad", "mag": "mag"}
"""Units by the words of names, as in ``separation_mas`` and ``delta_mag_error``."""


def unit_of(name: str) -> str:
    """Unit that a name holds; a pure number has none."""
    return next((UNITS[word] for word in name.split("_") if word in UNITS), "")


def labelled(
    variables: Mapping[str, tuple[Sequence[str], FloatArray]],
    coordinates: Mapping[str, Any],
    attributes: Mapping[str, Any],
) -> Any:
    """Make an `xarray.Dataset`, every variable and coordinate with its unit.

    Parameters
    ----------
    variables : mapping of str to (names of axes, array)
    coordinates : mapping of str to (n,) array
        By the name of their axis.
    attributes : mapping
        What is true of the whole; None is left out, as NetCDF has no such value.

    Returns
    -------
    xarray.Dataset

    Raises
    ------
    UsageError
        Where xarray is not installed.
    """
    xarray = optional_package("xarray", "labelled arrays need xarray", "xarray")
    kept = {name: value for name, value in attributes.items() if value is not None}
    data = xarray.Dataset(dict(variables), coords=dict(coordinates), attrs=kept)
    for name in data.variables:
        if unit := unit_of(str(name)):
            data[name].attrs["units"] = unit
    return data
