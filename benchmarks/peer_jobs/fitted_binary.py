"""What a peer says of a binary of two discs, as one line of JSON."""

import json
import time


def tell(fit: dict, names: dict, begin: float, **more: object) -> None:
    """Print the fit of a peer whose result has ``best``, ``uncer`` and ``chi2``, and what it took.

    Parameters
    ----------
    fit : dict
    names : dict of str to (str, float)
        Name of each quantity in the fit, and the factor to the unit of the label; 0 for a diameter,
        whose sign means nothing.
    begin : float
        Processor seconds when it began.
    """
    found = {}
    for label, (name, factor) in names.items():
        value, error = float(fit["best"][name]), float(fit["uncer"][name])
        found[label] = [factor * value, factor * error] if factor else [abs(value), error]
    found["reduced χ²"] = [float(fit["chi2"]), 0.0]
    print(json.dumps({"found": found, "cpu_s": time.process_time() - begin, **more}))
