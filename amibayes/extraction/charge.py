"""Charge migration of a visit: fitted to its ramps, or as the instrument's file has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from amibayes.cube import Cube
from amibayes.cube.ramps import RampFile
from amibayes.cube.reference_files import BIAS_KEYWORD, LINEARITY_KEYWORD
from amibayes.cube.source import Images, Source, opened
from amibayes.cube.write import SHIFT_KEYWORDS
from amibayes.data.shared_errors import SharedErrors
from amibayes.errors import UsageError
from amibayes.extraction.operator import ExtractionOperator
from amibayes.extraction.options import ExtractOptions
from amibayes.instrument import ChargeMigration, load_instrument
from amibayes.ramps.converter import WAVES, WaveColumns, table
from amibayes.ramps.correction import MigrationFree, electrons_of, slope_time_s
from amibayes.ramps.curvature import Curvature, curvature_of
from amibayes.ramps.fit import EXPLAINED, MigrationFit, fit_migration
from amibayes.ramps.header import P_VALUES, SOURCE, Cards, migration_cards, migration_of
from amibayes.ramps.migration import Migration
from amibayes.ramps.own_response import OwnResponse
from amibayes.ramps.transfer import KINDS, gain
from amibayes.support.terminal import equals
from amibayes.units import ComplexArray, FloatArray

TOO_FEW_GROUPS = "ramps of fewer than 4 groups cannot tell charge migration from flux"

BIAS_UNKNOWN = (
    "errors of the analogue-to-digital converter left in: the superbias that the ramps name "
    "(R_SUPERB) is neither beside them nor below CRDS_PATH, or has other pixels"
)


LINEARITY_UNKNOWN = (
    "errors of the analogue-to-digital converter fitted at counts as they were made linear: the "
    "coefficients that the ramps name (R_LINEAR) are neither beside them nor below CRDS_PATH, "
    "or are of other pixels"
)


@dataclass(frozen=True, eq=False)
class CubeMigration:
    """What is done about charge migration in one cube.

    Parameters
    ----------
    migration : Migration, optional
        Taken out; nothing is where it is absent.
    fit : MigrationFit, optional
        Of the ramps of the visit.
    notes : tuple of str
        What a reader of the result has to know.
    waves : WaveColumns, optional
        What errors of the converter do to the ramps of this cube.
    p_values : (float, float), optional
        Those of a fit, of changes and of bends, that is known from the header of a file only.
    """

    migration: Migration | None = None
    fit: MigrationFit | None = None
    notes: tuple[str, ...] = ()
    waves: WaveColumns | None = None
    p_values: tuple[float, float] | None = None

    @classmethod
    def of_header(cls, header: Mapping[str, Any]) -> CubeMigration | None:
        """What a file says of the images it was made of; None where it does not."""
        migration = migration_of(header)
        if migration is None:
            return cls() if header.get(SOURCE) == "off" else None
        p, bend = (header.get(key) for key in P_VALUES)
        if isinstance(p, int | float) and isinstance(bend, int | float):
            return cls(migration, p_values=(float(p), float(bend)))
        return cls(migration)

    @property
    def in_header(self) -> Cards:
        """Keywords by which `of_header` knows it again."""
        cards = migration_cards(self.migration)
        tests = self._tests
        if tests is not None:
            cards |= {f"HIERARCH {k}": p for k, p in zip(P_VALUES, tests, strict=True)}
        return cards

    @property
    def _tests(self) -> tuple[float, float] | None:
        """Probabilities of larger changes, and bends, than the ramps of the fit have."""
        if self.fit is None or self.migration is None or self.migration.source != "fit":
            return self.p_values
        return self.fit.p_value, self.fit.bend_p_value

    def applied(self, file: Source) -> Source:
        """The file without it."""
        if self.migration is None:
            return file
        template = file.template
        electrons = electrons_of(template)
        assert electrons is not None
        if not isinstance(file, RampFile):
            return MigrationFree(file, self.migration, electrons, slope_time_s(template.header))
        converter = self.migration.of_converter
        own = self.fit.own if self.fit and self.fit.pixels_differ else None
        if own is not None and own.value.shape != template.images.shape[1:]:
            own = None
        if converter is None or self.waves is None:
            return MigrationFree(file, self.migration, electrons, own=own)
        file = replace(file, excess_dn=table(converter.value))
        return MigrationFree(file, self.migration, electrons, waves=self.waves.current, own=own)

    def as_json(self) -> dict[str, Any]:
        """Plain numbers: value, error, source, and the tests of a fit."""
        if self.migration is None:
            return {"value_per_e": 0.0, "error_per_e": 0.0, "source": "off"}
        if self.migration.source == "fit" and self.fit is not None:
            return self.fit.as_json()
        if self.p_values is None:
            return self.migration.as_json()
        p, bend = self.p_values
        explained = min(p, bend) > EXPLAINED
        tests = {"p_value": p, "p_value_bend": bend, "explained": explained}
        return self.migration.as_json() | tests


@dataclass(frozen=True, eq=False)
class _Known:
    """One cube of a visit."""

    template: Cube
    is_ramp: bool
    curvature: Curvature | None
    stated: ChargeMigration | None
    lacks_linearity: bool = False


def visit_migration(
    cubes: Sequence[Images], options: ExtractOptions, header: Mapping[str, Any]
) -> list[CubeMigration]:
    """Find what charge migration is taken out of each cube, one fit for all of a detector.

    Parameters
    ----------
    cubes : sequence of Cube, path or Source
        Of targets and calibrators.
    options : ExtractOptions
    header : mapping
        As for `amibayes.extraction.extract`.
    """
    if options.charge_migration == "off":
        return [CubeMigration() for _ in cubes]
    known = [_known(cube, options, header) for cube in cubes]
    fits = {name: _fitted([k for k in known if _detector(k) == name])
            for name in dict.fromkeys(map(_detector, known))}  # fmt: skip
    return [_decided(k, fits[_detector(k)], options) for k in known]


def _detector(known: _Known) -> str:
    return known.template.instrument.upper()


def _known(cube: Images, options: ExtractOptions, header: Mapping[str, Any]) -> _Known:
    with opened(cube, **header) as file:
        is_ramp = isinstance(file, RampFile)
        wanted = options.charge_migration == "fit" and isinstance(file, RampFile)
        curvature = curvature_of(file) if wanted and isinstance(file, RampFile) else None
        named = LINEARITY_KEYWORD in file.template.header
        lacks = isinstance(file, RampFile) and named and file.linearity is None
        return _Known(file.template, is_ramp, curvature, _stated(file.template), lacks)


def _stated(template: Cube) -> ChargeMigration | None:
    """What the instrument's file knows; nothing of images that were simulated without."""
    shifts = [template.header.get(key) for key in SHIFT_KEYWORDS]
    if all(shift == 0.0 for shift in shifts):
        return None
    try:
        return load_instrument(template.instrument, template.filter).charge_migration
    except UsageError:
        return None  # the extraction says what is wrong


def _fitted(known: Sequence[_Known]) -> MigrationFit | None:
    measured = [k.curvature for k in known if k.curvature is not None]
    return fit_migration(measured) if measured else None


def _decided(known: _Known, fit: MigrationFit | None, options: ExtractOptions) -> CubeMigration:
    migration, notes = _chosen(known, fit, options)
    if migration is None:
        return CubeMigration(None, fit, notes)
    waves = None if known.curvature is None else known.curvature.waves
    if waves is None and known.curvature is not None and known.template.header.get(BIAS_KEYWORD):
        notes = (*notes, BIAS_UNKNOWN)
    if waves is not None and known.lacks_linearity:
        notes = (*notes, LINEARITY_UNKNOWN)
    if not known.is_ramp:
        missing = _missing(known.template)
        if missing:
            return CubeMigration(
                None, fit, (*notes, f"charge migration not taken out: the header lacks {missing}")
            )
    text = stated(migration.of_pixels if waves is None else migration)
    if known.is_ramp and fit is not None and fit.own is not None and fit.pixels_differ:
        text += (
            f"; single pixels differ in their linearity by {1e7 * fit.own.spread:.2f} e-7 per "
            "electron (rms), taken out as far as they tell it"
        )
    return CubeMigration(migration, fit, (*notes, text), waves)


def _chosen(
    known: _Known, fit: MigrationFit | None, options: ExtractOptions
) -> tuple[Migration | None, tuple[str, ...]]:
    """What to take out, and what there is to say of how that was found."""
    if isinstance(options.charge_migration, float):
        return Migration.isotropic(options.charge_migration, 0.0, "given"), ()
    before = known.stated
    notes = (TOO_FEW_GROUPS,) if known.is_ramp and known.curvature is None else ()
    if fit is not None and (before is None or fit.migration.mean[1] < before.error):
        if not fit.explained:
            notes = (*notes, f"charge migration does not explain all that changes along the "
                     f"ramps (p {equals(min(fit.p_value, fit.bend_p_value))})")  # fmt: skip
        return fit.migration, notes
    if before is None:
        return None, notes
    of_file = Migration.isotropic(before.per_e, before.error, "instrument")
    converter = None if fit is None else fit.migration.of_converter
    return (of_file if converter is None else of_file.beside(converter)), notes


def _missing(template: Cube) -> str:
    """What the correction of slopes asks of a header and does not find; empty where it does."""
    wanted = []
    if slope_time_s(template.header) is None:
        wanted.append("NGROUPS and TGROUP")
    if electrons_of(template) is None:
        wanted.append("a unit of electrons or DN per second")
    return ", and ".join(wanted)


def stated(migration: Migration) -> str:
    """Say in a line what is taken out."""
    value, error = migration.mean
    origin = {"fit": "fitted to ramps", "instrument": "of the instrument's file"}
    text = (
        f"charge migration taken out: {1e7 * value:.2f} ± {1e7 * error:.2f} e-7 pixels per "
        f"electron, {origin.get(migration.source, migration.source)}"
    )
    converter = migration.of_converter
    if converter is None:
        return text
    sine, cosine = (
        f"{1e6 * converter.value[k]:.1f} ± {1e6 * converter.error[k]:.1f}" for k in (0, 1)
    )
    return (
        f"{text}; errors of the converter too, per million counts and with a period of 1024: "
        f"sine {sine}, cosine {cosine}, fitted to ramps"
    )


def observable_changes(
    file: MigrationFree, operator: ExtractionOperator, samples: ComplexArray, flux: float
) -> FloatArray:
    """Changes (n_observables, r) of V² and closure phases by errors of the coefficients.

    Parameters
    ----------
    file : MigrationFree
    operator : ExtractionOperator
    samples : (n_samples,) complex array
        Mean of the file, without migration.
    flux : float
        Likewise.

    Returns
    -------
    (n_observables, r) array
        For one standard deviation along each of `Migration.directions`, and of each pixel that
        changes of its own.
    """
    migration, sampling = file.migration, operator.sampling
    current = operator.reference.image * file.electrons
    charge = file.mean_time_s * current
    moved = np.stack([_change(kind, charge, current, file.waves) for kind in migration.kinds])
    images = -np.tensordot(migration.directions.T, moved, axes=1) / file.electrons
    images = np.concatenate(
        [images, -_of_single_pixels(file.own, charge, current) / file.electrons]
    )
    view = operator.view
    pixels = images[:, view.rows, view.columns].reshape(len(images), operator.scatter.size)
    by_flux, by_samples = sampling.apply(pixels)
    sides = []
    for sign in (1.0, -1.0):
        moved_samples = samples + sign * by_samples
        vis2 = sampling.power(moved_samples) / (flux + sign * by_flux)[:, None] ** 2
        sides.append((vis2, sampling.bispectrum(moved_samples)))
    (high, high3), (low, low3) = sides
    closure = np.angle(high3 * low3.conj())
    return np.asarray(0.5 * np.concatenate([high - low, closure], axis=1).T)


def _of_single_pixels(
    own: OwnResponse | None, charge: FloatArray, current: FloatArray
) -> FloatArray:
    """Currents (m, ny, nx) that errors of single pixels make, one standard deviation each."""
    if own is None:
        return np.empty((0, *current.shape))
    row, column = own.carried.T
    images = np.zeros((len(row), *current.shape))
    number = np.arange(len(row))
    images[number, row, column] = (own.error * charge * current)[row, column]
    return images


def _change(
    kind: str, charge: FloatArray, current: FloatArray, waves: FloatArray | None
) -> FloatArray:
    """Current (ny, nx) that a coefficient of 1 makes."""
    if kind in KINDS:
        return gain(kind, charge, current)
    return np.zeros_like(current) if waves is None else waves[WAVES.index(kind)]


def shared_errors(parts: Sequence[tuple[Migration, FloatArray]]) -> SharedErrors | None:
    """Sum of changes (n_observables, r) by each migration, under names that others share."""
    total: dict[str, FloatArray] = {}
    for migration, changes in parts:
        names = migration.error_names(changes.shape[1])
        for name, change in zip(names, changes.T, strict=True):
            total[name] = total.get(name, 0.0) + change
    if not total:
        return None
    return SharedErrors(tuple(total), np.stack(list(total.values()), axis=1))
