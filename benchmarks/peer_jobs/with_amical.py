"""AMICAL: clean a cube and extract bispectra. Arguments: a FITS cube in the primary HDU."""

import sys
import time
import warnings

import amical
from astropy.io import fits

warnings.simplefilter("ignore")
path = sys.argv[1]
n = fits.getheader(path)["NAXIS3"]
for _trial in range(2):  # The first time fills caches.
    begin = time.process_time()
    cube = amical.select_clean_data(
        path, isz=79, r1=33, dr=3, apod=True, window=35, clip=False, display=False
    )
    amical.extract_bs(
        cube,
        path,
        targetname="star",
        instrum="NIRISS",
        maskname="g7",
        filtname="F480M",
        peakmethod="fft",
        bs_multi_tri=False,
        display=False,
        verbose=False,
    )
    seconds = time.process_time() - begin
print("cpu_s extraction_per_integration", seconds / n)
