"""Real and third-party files give the published numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.search import search
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.oifits import read_oifits
from amibayes.pipeline.field import search_field
from amibayes.pipeline.options import SearchOptions


def searched(
    path: Path, model: BinaryModel, field=None, kinds=("vis2", "cp"), covariance="assumed"
) -> SearchResult:
    data = read_oifits(path, closure_covariance=covariance)
    return search(Likelihood(data.only(kinds), model), field)


FREE = BinaryModel(diameter_mas="free")


@pytest.mark.parametrize(
    "covariance", ["diagonal", pytest.param("assumed", marks=pytest.mark.slow)]
)
def test_ax_cir_is_found_over_the_whole_field(data: Path, covariance: str) -> None:
    """Gallenne et al. (2014) and CANDID: x 6.24, y −28.51 mas, 0.8–0.82 mas, 0.98 → 0.73."""
    path = data / "oifits" / "axcir_pionier.oifits"
    result = searched(path, FREE, (0.6, 50.0), covariance=covariance)
    c = result.companion
    assert np.hypot(c.east_mas - 6.24, c.north_mas + 28.51) < 0.1
    assert c.contrast == pytest.approx(0.0090, abs=0.0005)
    assert result.nuisance("diameter_mas") == pytest.approx(0.82, abs=0.01)
    if covariance == "diagonal":
        assert result.chi2_single / result.ndof == pytest.approx(0.98, abs=0.005)
        assert result.chi2_binary / result.ndof == pytest.approx(0.73, abs=0.005)
        assert result.candid_n_sigma > 8.0


@pytest.mark.slow
def test_ax_cir_without_smearing_and_with_closures_alone(data: Path) -> None:
    """Without smearing PMOIRED finds 0.883 %; closures alone fall on a false peak at 6.5 mas."""
    path = data / "oifits" / "axcir_pionier.oifits"
    plain = searched(
        path, BinaryModel(diameter_mas="free", smearing=False), (0.6, 50.0), covariance="diagonal"
    )
    assert plain.companion.contrast == pytest.approx(0.0083, abs=0.0005)
    closures = searched(path, BinaryModel(), (0.6, 50.0), ("cp",), "diagonal")
    assert closures.companion.separation_mas == pytest.approx(6.5, abs=0.1)
    assert len(closures.modes) > 1


def test_closures_of_ax_cir_alone_do_not_tell_where(data: Path) -> None:
    """Its companion is at 29.2 mas, outside the default field; inside, 5.7 mas is a false peak.

    The file has the triangles of every exposure in another order.
    """
    ax_cir = read_oifits(data / "oifits" / "axcir_pionier.oifits")
    found = search_field(ax_cir, SearchOptions(observables=("cp",)))
    assert found.result.companion.separation_mas == pytest.approx(5.7, abs=0.1)
    assert len(found.result.rivals) >= 2
    assert any("outside the field" in w and "not certain" in w for w in found.warnings)


def test_ax_cir_with_the_covariances_of_the_file(data: Path) -> None:
    """Fouriever: 0.934 ± 0.040 %, 0.816 mas, with channels smeared 1.4 times too wide.

    The file's closure correlations have the wrong sign in half of its exposures.
    """
    result = searched(data / "oifits" / "axcir_pionier_cov.oifits", FREE, (0.6, 50.0))
    assert any("contradict" in note for note in result.likelihood.observables.notes)
    assert result.companion.contrast == pytest.approx(0.0093, abs=0.0004)
    assert np.hypot(result.companion.east_mas - 6.24, result.companion.north_mas + 28.51) < 0.1


def test_niriss_binary_of_amical(data: Path) -> None:
    """Truth 147.7 mas, 46.6°, 6.0 mag; CANDID on the closure phases 147.13, 46.77, 5.98."""
    path = data / "oifits" / "niriss_f430m_amical.oifits"
    both = searched(path, BinaryModel()).companion
    assert both.separation_mas == pytest.approx(147.4, abs=0.8)
    assert both.position_angle_deg == pytest.approx(46.7, abs=0.4)
    assert both.delta_mag == pytest.approx(5.99, abs=0.04)
    model = BinaryModel(smearing=False)
    closures = searched(path, model, (50.0, 400.0), ("cp",), "diagonal").companion
    assert closures.separation_mas == pytest.approx(147.13, abs=0.03)
    assert closures.position_angle_deg == pytest.approx(46.77, abs=0.02)
    assert closures.delta_mag == pytest.approx(5.98, abs=0.005)


@pytest.mark.slow
def test_binary_of_the_imaging_contest(data: Path) -> None:
    """Two resolved stars, 5 mas apart: points do not fit well, and the place is right."""
    path = data / "oifits" / "contest2008_binary.oifits"
    found = searched(path, FREE, (0.3, 20.0)).companion
    assert found.separation_mas == pytest.approx(5.0, abs=0.05)
    assert found.position_angle_deg == pytest.approx(30.0, abs=0.5)
