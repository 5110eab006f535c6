"""jwst: ami_analyze of calints, and ami_normalize, without a file of CRDS.

Arguments: ``--reuse`` (keep the fringe models of like centres), a .npz of mask and filter
(`benchmarks.jwst_pipeline.write_optics`), a folder for the products, the calints of the target,
and those of its calibrators. Normalized is with the first calibrator alone, as the pipeline does.
"""

import logging
import os
import sys
import time
import warnings

# Nothing is asked of CRDS: both reference files are given, and nothing else is looked up.
os.environ.setdefault("CRDS_SERVER_URL", "http://127.0.0.1:9")
os.environ.setdefault("CRDS_PATH", os.path.dirname(__file__))
os.environ.setdefault("CRDS_CONTEXT", "jwst_0000.pmap")

import jwst
import numpy as np
from jwst.ami import AmiAnalyzeStep, AmiNormalizeStep, lg_model
from stdatamodels.jwst import datamodels

FILTER_ROW = [("wavelength", "f4"), ("throughput", "f4")]


def references(optics, folder):
    """Write the throughput and the mask as reference files; return their paths."""
    known = np.load(optics)
    common = {"telescope": "JWST", "useafter": "2022-01-01T00:00:00", "author": "amibayes",
              "pedigree": "SIMULATION", "description": "of amibayes"}  # fmt: skip
    paths = [os.path.join(folder, f"{kind}.fits") for kind in ("throughput", "nrm")]
    table = np.array(list(zip(known["angstrom"], known["throughput"], strict=True)), FILTER_ROW)
    with datamodels.ThroughputModel(filter_table=table) as model:
        model.meta.instrument.name = "NIRISS"
        model.meta.instrument.filter = str(known["filter"])
        model.meta.reftype = "throughput"
        for key, value in common.items():
            setattr(model.meta, key, value)
        model.save(paths[0])
    with datamodels.NRMModel(nrm=known["pupil"].astype("f4")) as model:
        model.meta.instrument.name = "NIRISS"
        model.meta.reftype = "nrm"
        for key, value in common.items():
            setattr(model.meta, key, value)
        model.diameter, model.pupil_circumscribed = 6.559348, 6.603464
        model.flat_to_flat = float(known["flat_to_flat"])
        for k, (x, y) in enumerate(known["holes"], 1):
            setattr(model, f"x_a{k}", float(x))
            setattr(model, f"y_a{k}", float(y))
        model.save(paths[1])
    return paths


def analyze(path, folder, throughput, nrm):
    """Run the step on one exposure; write its products; return its averages."""
    step = AmiAnalyzeStep()
    step.override_throughput, step.override_nrm = throughput, nrm
    begin = time.process_time()
    # `run` would ask CRDS for the context, to write it into the header.
    oi, multi, residuals = step.process(path)
    seconds = time.process_time() - begin
    stem = os.path.basename(path).removesuffix("_calints.fits")
    calibrator = bool(oi.meta.exposure.psf_reference)
    for product in (oi, multi, residuals):
        product.meta.calibration_software_version = jwst.__version__
    oi.save(os.path.join(folder, f"{stem}_{'psf-' if calibrator else ''}ami-oi.fits"))
    multi.save(os.path.join(folder, f"{stem}_amimulti-oi.fits"))
    residuals.save(os.path.join(folder, f"{stem}_amilg.fits"))
    return oi, seconds


def reuse_models():
    """Keep the fringe model of centres that agree to a twentieth of a pixel.

    Its envelope, 18 pixels wide, stays where it is, and its fringes are turned to each centre.
    Left where they are their phases would hop by twentieths of a pixel, a hundred times the
    noise, and the step averages phases after it has clipped those that differ, baseline by
    baseline: its closure phases would have errors that they do not have.
    """
    make, kept = lg_model.LgModel.make_model, {}

    def make_model(self, fov, psf_offset=(0, 0)):
        near = np.round(np.multiply(psf_offset, 20.0)) / 20.0
        key = (fov, *near)
        if key not in kept:
            make(self, fov, tuple(near))
            kept[key] = self.model
        self.fov = fov
        self.model = turned(self, kept[key], np.subtract(psf_offset, near))
        return self.model

    lg_model.LgModel.make_model = make_model


def turned(self, model, offset):
    """Fringes of a model about a centre that is ``offset`` (x, y) pixels farther."""
    weight, wavelength = np.transpose([row for row in self.bandpass])
    place = np.array(self.affine2d.distort_f_args(offset[1], offset[0]))
    n = len(self.ctrs)
    baselines = np.array([self.ctrs[i] - self.ctrs[j] for i in range(n) for j in range(i + 1, n)])
    waves = baselines @ place * self.pixel / np.average(wavelength, weights=weight)
    phase = np.exp(2j * np.pi * waves)
    new = model.copy()
    cosine, sine = model[..., 1:-1:2], model[..., 2:-1:2]
    new[..., 1:-1:2] = cosine * phase.real + sine * phase.imag
    new[..., 2:-1:2] = sine * phase.real - cosine * phase.imag
    return new


def main():
    if "--reuse" in sys.argv:
        sys.argv.remove("--reuse")
        reuse_models()
    optics, folder, target, *calibrators = sys.argv[1:]
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    throughput, nrm = references(optics, folder)
    done = [analyze(path, folder, throughput, nrm) for path in (target, *calibrators)]
    begin = time.process_time()
    if calibrators:
        normalized = AmiNormalizeStep().process(done[0][0], done[1][0])
        stem = os.path.basename(target).removesuffix("_calints.fits")
        normalized.save(os.path.join(folder, f"{stem}_aminorm-oi.fits"))
    print("cpu_s analyze", sum(seconds for _, seconds in done))
    print("cpu_s normalize", time.process_time() - begin)


main()
