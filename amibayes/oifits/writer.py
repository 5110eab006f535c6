"""`Observables` as an OIFITS 2 file that loses nothing: not a correlation, not a last digit.

The standard wants degrees and single-precision wavelengths. What rounding to them loses is
kept beside, in columns ``NS_…_REST`` that other programs pass over (the standard reserves the
prefix NS_ for columns of one's own); `read_oifits` adds it again.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from amibayes import __version__
from amibayes.data.observables import Observables
from amibayes.errors import DataError, UsageError
from amibayes.oifits.correlations import pair_covariance
from amibayes.oifits.dates import first_date
from amibayes.oifits.layout import UNKNOWN, Grid, Layout, grids_of, measurements_of, printable
from amibayes.oifits.off_axis import response_tables
from amibayes.oifits.rows import T3, VIS2, Kind
from amibayes.oifits.scatter import scatter_table, shared_table
from amibayes.oifits.standard import TABLES
from amibayes.oifits.tables import OWN_KEY
from amibayes.support.arguments import checks_arguments
from amibayes.support.atomic_files import atomic_path
from amibayes.units import DEGREE, BoolArray, FloatArray, IntArray

CORRNAME = "AMIBAYES"
ARCSEC = DEGREE / 3600.0

HeaderValue = str | int | float | bool


@checks_arguments
def write_oifits(
    path: str | Path,
    observables: Observables,
    *,
    header: Mapping[str, HeaderValue] | None = None,
    overwrite: bool = False,
) -> None:
    """Write observables and their full covariance as an OIFITS 2 file, whole or not at all.

    Parameters
    ----------
    path : str or path
    observables : Observables
    header : mapping, optional
        Keywords of the primary header, such as OBSERVER or PROG_ID.
    overwrite : bool
        Replace a file that is there.

    Raises
    ------
    UsageError
        Where the file is there and ``overwrite`` is false.
    RunError
        Where it cannot be written.
    """
    if Path(path).exists() and not overwrite:
        raise UsageError("is there already", source=path, remedy="choose another name")
    if any(s.kernel is not None for s in observables.setups):
        raise DataError(
            "OIFITS has no place for kernel phases",
            source=observables.source,
            remedy="write them with amibayes.kpfits.write_kpfits",
        )
    hdus = to_hdus(observables, header or {})
    with atomic_path(path) as temporary:
        hdus.writeto(temporary, overwrite=True, output_verify="exception")


def to_hdus(observables: Observables, header: Mapping[str, HeaderValue]) -> fits.HDUList:
    """The HDUs that `write_oifits` writes."""
    layout = Layout.of(observables)
    tables = [_target_table(layout)]
    tables += [_array_table(layout, i) for i in range(len(layout.arrays))]
    tables += [_wavelength_table(layout, i) for i in range(len(layout.channels))]
    grids = grids_of(observables)
    correlated = _needs_correlations(observables)
    tables += [_data_table(observables, layout, grid, correlated) for grid in grids]
    if correlated:
        tables.append(_correlation_table(observables, grids))
    if correlated:
        tables += _own_tables(observables, _correlation_index(observables, grids))
    tables += response_tables(layout, observables.setups)
    seen: dict[str, int] = {}
    for table in tables:
        seen[table.name] = table.header["EXTVER"] = seen.get(table.name, 0) + 1
    return fits.HDUList([_primary(observables, layout, header), *tables])


def _own_tables(observables: Observables, index: IntArray) -> list[fits.BinTableHDU]:
    """What OI_CORR does not tell of a covariance, by the places ``index`` of the data in it."""
    variance, tables = observables.covariance.variance, []
    if observables.scatter is not None:
        tables.append(scatter_table(observables.scatter, variance, index, CORRNAME))
    if observables.shared is not None and observables.shared.names:
        tables.append(shared_table(observables.shared, variance, index, CORRNAME))
    return tables


def _table(name: str, columns: Mapping[str, Any], extra: Mapping[str, Any], n_channels: int) -> Any:
    """A binary table with the columns of the standard, then columns of our own."""
    rules = [rule for rule in TABLES[name].columns if rule.name in columns]
    built = []
    for rule in rules:
        values, form = columns[rule.name], rule.tform(n_channels)
        if rule.letter == "A":
            form = f"{max([rule.repeat, *(len(v) for v in values)])}A"
        built.append(fits.Column(rule.name, form, unit=rule.unit or None, array=values))
    for own, values in extra.items():
        letter = "J" if values.dtype.kind == "i" else "D"
        width = values.shape[1] if values.ndim == 2 else 1
        built.append(fits.Column(f"NS_{own}", f"{width}{letter}", array=values))
    table = fits.BinTableHDU.from_columns(built, name=name)
    table.header["OI_REVN"] = (TABLES[name].revision[1], "revision of the table definition")
    return table


def _own(table: Any, keyword: str, value: HeaderValue) -> None:
    """Set one of our own hierarchical keywords."""
    table.header[f"HIERARCH {OWN_KEY} {keyword}"] = _card_value(value)


def _primary(
    observables: Observables, layout: Layout, header: Mapping[str, HeaderValue]
) -> fits.PrimaryHDU:
    hdu = fits.PrimaryHDU()
    names = [s.target or UNKNOWN for s in layout.targets]
    mjd = np.concatenate([observables.vis2.mjd, observables.closure_phase.mjd])
    standard: dict[str, HeaderValue] = {
        "ORIGIN": UNKNOWN,
        "DATE": _today(),
        "DATE-OBS": first_date(mjd),
        "CONTENT": "OIFITS2",
        "TELESCOP": _one(layout.arrnames),
        "INSTRUME": _one(layout.insnames),
        "OBSERVER": UNKNOWN,
        "OBJECT": _one(names),
        "INSMODE": UNKNOWN,
        "PROCSOFT": f"amibayes {__version__}",
    }
    for name, value in (standard | dict(header)).items():
        hdu.header[name] = _card_value(value)
    return hdu


def _card_value(value: HeaderValue) -> HeaderValue:
    return printable(value) if isinstance(value, str) else value


def _one(names: list[str]) -> str:
    return names[0] if len(set(names)) == 1 else "MULTI"


def _today() -> str:
    """Day of writing, or of SOURCE_DATE_EPOCH for files that have to be reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    now = datetime.fromtimestamp(int(epoch), UTC) if epoch.isdigit() else datetime.now(UTC)
    return now.strftime("%Y-%m-%d")


def _target_table(layout: Layout) -> Any:
    targets = layout.targets
    zero = np.zeros(len(targets))
    rules = TABLES["OI_TARGET"].columns
    columns: dict[str, Any] = {rule.name: zero for rule in rules if not rule.optional}
    columns |= {
        "TARGET_ID": np.arange(1, len(targets) + 1),
        "TARGET": [printable(s.target) or UNKNOWN for s in targets],
        "RAEP0": np.array([s.right_ascension_deg for s in targets]),
        "DECEP0": np.array([s.declination_deg for s in targets]),
        "EQUINOX": np.full(len(targets), 2000.0),
        "VELTYP": [UNKNOWN] * len(targets),
        "VELDEF": ["OPTICAL"] * len(targets),
        "SPECTYP": [UNKNOWN] * len(targets),
    }
    return _table("OI_TARGET", columns, {}, 1)


def _array_table(layout: Layout, number: int) -> Any:
    setup = layout.arrays[number]
    n = len(setup.stations)
    diameter = setup.station_diameter_m
    diameter = np.zeros(n) if diameter is None else diameter
    single, rest = _single(diameter)
    xyz = np.zeros((n, 3)) if setup.station_xyz_m is None else setup.station_xyz_m
    with np.errstate(divide="ignore", invalid="ignore"):
        # An aperture of diameter D sees a field of λ/D; zero stands for unknown.
        fov = np.where(diameter > 0, np.mean(setup.wavelength_m) / diameter / ARCSEC, 0.0)
    columns = {
        "TEL_NAME": list(setup.stations),
        "STA_NAME": list(setup.stations),
        "STA_INDEX": layout.station_index(layout.array.index(number)),
        "DIAMETER": single,
        "STAXYZ": xyz,
        "FOV": fov,
        "FOVTYPE": ["FWHM"] * n,
    }
    table = _table("OI_ARRAY", columns, _only_needed({"DIAMETER_REST": rest}), 1)
    table.header["ARRNAME"] = layout.arrnames[number]
    # Holes of a mask and stations of unknown place are given on the sky.
    table.header["FRAME"] = (printable(setup.array_frame) or "SKY", "of the station coordinates")
    for axis, value in zip("XYZ", setup.array_centre_m, strict=True):
        table.header[f"ARRAY{axis}"] = value if np.isfinite(value) else 0.0
    if layout.arrnames[number] != setup.arrname:
        _own(table, "ARRNAME", setup.arrname)
    return table


def _wavelength_table(layout: Layout, number: int) -> Any:
    setup = layout.channels[number]
    (wave, wave_rest), (band, band_rest) = _single(setup.wavelength_m), _single(setup.band_m)
    rest = _only_needed({"EFF_WAVE_REST": wave_rest, "EFF_BAND_REST": band_rest})
    table = _table("OI_WAVELENGTH", {"EFF_WAVE": wave, "EFF_BAND": band}, rest, 1)
    table.header["INSNAME"] = layout.insnames[number]
    if layout.insnames[number] != setup.insname:
        _own(table, "INSNAME", setup.insname)
    return table


def _single(values: FloatArray) -> tuple[NDArray[np.float32], FloatArray]:
    """Single precision, and what that loses."""
    single = values.astype(np.float32)
    return single, np.nan_to_num(values - single.astype(float))


def _only_needed(columns: dict[str, Any]) -> dict[str, Any]:
    """The columns that are not zero throughout."""
    return {name: values for name, values in columns.items() if np.any(values)}


def _data_table(observables: Observables, layout: Layout, grid: Grid, correlated: bool) -> Any:
    kind, m = grid.kind, measurements_of(observables, grid.kind)
    variance = _variance(observables, kind)[grid.entries]
    written, rests = _values_and_errors(kind, m.value[grid.entries], variance)
    columns: dict[str, Any] = {name: grid.spread(v, np.nan) for name, v in written.items()}
    extra: dict[str, Any] = {
        f"{name}_REST": grid.spread(rest, 0.0) for name, rest in rests.items() if rest.any()
    }
    n_rows, first = len(grid.first), grid.first
    if not grid.in_order:
        extra["ENTRY"] = grid.spread(grid.entries + 1, 0)
    columns |= {
        "TARGET_ID": np.full(n_rows, layout.target[grid.setup] + 1),
        "TIME": np.zeros(n_rows),
        "MJD": m.mjd[first],
        "INT_TIME": m.integration_s[first],
        "STA_INDEX": layout.station_index(grid.setup)[m.stations[first]],
        "FLAG": grid.spread(m.flag[grid.entries], True),
    }
    columns |= {name: m.u_m[first, i] for i, name in enumerate(kind.u)}
    columns |= {name: m.v_m[first, i] for i, name in enumerate(kind.v)}
    if kind is T3:
        columns |= {n: np.full((n_rows, grid.n_channels), np.nan) for n in ("T3AMP", "T3AMPERR")}
    if correlated:
        columns[kind.index] = 1 + grid.start + np.arange(n_rows) * grid.n_channels
    table = _table(kind.table, columns, extra, grid.n_channels)
    _describe(table, observables, layout, grid, correlated)
    return table


def _describe(
    table: Any, observables: Observables, layout: Layout, grid: Grid, correlated: bool
) -> None:
    """The keywords of a data table."""
    m = measurements_of(observables, grid.kind)
    table.header["DATE-OBS"] = first_date(m.mjd[grid.entries])
    table.header["ARRNAME"] = layout.arrnames[layout.array[grid.setup]]
    table.header["INSNAME"] = layout.insnames[layout.channel[grid.setup]]
    if correlated:
        table.header["CORRNAME"] = CORRNAME
    _own(table, "SETUP", grid.setup + 1)
    if grid.kind is T3 and _independent_closures(observables)[grid.entries].all():
        _own(table, "CLOSURES", "independent")


def _values_and_errors(
    kind: Kind, value: FloatArray, variance: FloatArray
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Columns in the standard's units, and what they lose of the value and of the variance."""
    scale = DEGREE if kind.is_angle else 1.0
    written, error = value / scale, np.sqrt(variance) / scale
    with np.errstate(invalid="ignore"):
        value_rest = np.nan_to_num(value - written * scale, posinf=0.0, neginf=0.0)
        rest = np.nan_to_num(variance - (error * scale) ** 2)
    return {kind.value: written, kind.error: error}, {kind.value: value_rest, kind.error: rest}


def _variance(observables: Observables, kind: Kind) -> FloatArray:
    """Of every entry of a kind; NaN where flagged."""
    m = measurements_of(observables, kind)
    used = observables.covariance.variance
    shift = 0 if kind is VIS2 else observables.n_vis2
    out = np.full(len(m), np.nan)
    out[~m.flag] = used[shift : shift + int((~m.flag).sum())]
    return out


def _independent_closures(observables: Observables) -> BoolArray:
    """Closure phases that stand alone, without kernel basis; flagged ones go with the rest."""
    out = np.ones(len(observables.closure_phase), dtype=bool)
    used = np.flatnonzero(~observables.closure_phase.flag)
    for stack in observables.covariance.stacks:
        if stack.shape[0] > 1 or stack.basis is not None:
            closures = stack.index[stack.index >= observables.n_vis2] - observables.n_vis2
            out[used[closures]] = False
    return out


def _needs_correlations(observables: Observables) -> bool:
    """Whether the file needs an OI_CORR: for correlations, or to say of what kind they are."""
    return not (
        observables.covariance_kind == "diagonal"
        and observables.n_integrations is None
        and observables.freedom is None
        and observables.covariance.independent
    )


def _correlation_table(observables: Observables, grids: list[Grid]) -> Any:
    first, second, covariance = _pairs(observables)
    variance = observables.covariance.variance
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = covariance / pair_covariance(
            np.ones(len(first)), variance[first], variance[second]
        )
    correlation = np.clip(correlation, -1.0, 1.0)
    rest = covariance - pair_covariance(correlation, variance[first], variance[second])
    index = _correlation_index(observables, grids)
    low, high = np.minimum(index[first], index[second]), np.maximum(index[first], index[second])
    order = np.lexsort((high, low))
    columns = {"IINDX": low[order], "JINDX": high[order], "CORR": correlation[order]}
    table = _table("OI_CORR", columns, _only_needed({"CORR_REST": rest[order]}), 1)
    table.header["CORRNAME"] = CORRNAME
    table.header["NDATA"] = sum(len(g.first) * g.n_channels for g in grids)
    _own(table, "COVARIANCE", observables.covariance_kind)
    if observables.n_integrations is not None:
        _own(table, "NINT", observables.n_integrations)
    if observables.freedom is not None:
        _own(table, "DOF", observables.freedom.degrees)
        _own(table, "SCATDOF", observables.freedom.scatter)
    return table


def _pairs(observables: Observables) -> tuple[IntArray, IntArray, FloatArray]:
    """Every covariance that is not zero: places in the data vector, value."""
    firsts, seconds, values = [np.empty(0, np.intp)], [np.empty(0, np.intp)], [np.empty(0)]
    for block in observables.covariance.blocks:
        if len(block.index) > 1:
            i, j = np.triu_indices(len(block.index), 1)
            used = block.matrix[i, j] != 0
            firsts.append(block.index[i[used]])
            seconds.append(block.index[j[used]])
            values.append(block.matrix[i[used], j[used]])
    return np.concatenate(firsts), np.concatenate(seconds), np.concatenate(values)


def _correlation_index(observables: Observables, grids: list[Grid]) -> IntArray:
    """1-based place in the correlation matrix of every datum in use."""
    out = {
        VIS2: np.zeros(len(observables.vis2), dtype=np.intp),
        T3: np.zeros(len(observables.closure_phase), dtype=np.intp),
    }
    for grid in grids:
        out[grid.kind][grid.entries] = 1 + grid.start + grid.cell
    return np.concatenate(
        [out[VIS2][~observables.vis2.flag], out[T3][~observables.closure_phase.flag]]
    )
