"""Data sets that tests make for themselves."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from amibayes.data.observables import Observables
from amibayes.data.point_source import point_source
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.units import FloatArray

NIRISS_HOLES = np.array(
    [
        [0.0, -2.64],
        [-2.28631, 0.0],
        [2.28631, -1.32],
        [-2.28631, 1.32],
        [-1.14315, 1.98],
        [2.28631, 1.32],
        [1.14315, 1.98],
    ]
)


def niriss(
    vis2_error: float = 0.005,
    closure_error_deg: float = 0.3,
    covariance: str = "assumed",
    channels: int = 1,
) -> Observables:
    """A point source seen by NIRISS through F480M, in one channel or several narrower ones."""
    wavelength = 4.817e-6 + 0.302e-6 * ((np.arange(channels) + 0.5) / channels - 0.5)
    return point_source(
        NIRISS_HOLES,
        wavelength,
        0.302e-6 / channels,
        vis2_error=vis2_error,
        closure_error_rad=np.radians(closure_error_deg),
        covariance=covariance,
    )


def simulated(
    sheet: Observables,
    theta: object,
    rng: np.random.Generator | None,
    model: BinaryModel | None = None,
    shift_closure: float = 0.0,
) -> Observables:
    """The data a binary would give, with noise of the sheet's covariance (none without rng)."""
    likelihood = Likelihood(sheet, model)
    data = likelihood.predict([theta])[:, 0]
    if rng is not None:
        data = data + sheet.covariance.draw(rng, 1)[:, 0]
    data[len(sheet.vis2) :] += shift_closure
    return sheet.with_data(data)


def named_star(sheet: Observables, name: str, rng: np.random.Generator) -> Observables:
    """A noisy star of V² 0.8 in the coverage of a sheet of one setup."""
    noise = sheet.covariance.draw(rng, 1)[:, 0]
    n = len(sheet.vis2)
    return replace(
        sheet,
        vis2=replace(sheet.vis2, value=0.8 + noise[:n]),
        closure_phase=replace(sheet.closure_phase, value=noise[n:]),
        setups=(replace(sheet.setups[0], target=name),),
    )


def error_of(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that a command left on standard error, with nothing on standard output."""
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.strip().split("\n")
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("amibayes")
    return lines[0]


def numerical_gradient(likelihood: Likelihood, theta: FloatArray, step: FloatArray) -> FloatArray:
    """Gradient of the log-likelihood by central differences of a step (n_dim,)."""
    shifted = theta + np.vstack([np.diag(step), -np.diag(step)])
    plus, minus = np.split(likelihood.log_prob(shifted), 2)
    return np.asarray((plus - minus) / (2 * step))


def script_of_docs(name: str) -> ModuleType:
    """A script of the documentation, as a module."""
    path = Path(__file__).resolve().parents[1] / "docs" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # where it is when it is run, with those it imports
    spec.loader.exec_module(module)
    return module
