"""Numbers as a reader wants them: as many digits as the error leaves, and a dash for none."""

from __future__ import annotations

import math

from amibayes.support.terminal import LEAST_TOLD

NONE = "–"

PLUS_MINUS, TIMES = " ±\u00a0", "\u00a0×\u00a0"
"""Where it is narrow the error goes below its value; a number itself is not broken."""

SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def plain(value: float | None, digits: int = 3) -> str:
    """Write a number with so many digits that count; powers of ten where it is far from 1."""
    if value is None or not math.isfinite(value):
        return NONE
    rounded = float(f"{value:.{digits - 1}e}")
    if rounded and not 1e-4 <= abs(rounded) < 1e6:
        mantissa, power = f"{rounded:.{digits - 1}e}".split("e")
        shown = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
        return f"{shown}{TIMES}10{str(int(power)).translate(SUPERSCRIPT)}".replace("-", "−")
    places = max(0, digits - 1 - _power(rounded)) if rounded else 0
    text = f"{rounded:.{places}f}"
    return (text.rstrip("0").rstrip(".") if "." in text else text).replace("-", "−")


def fixed(value: float | None, places: int) -> str:
    """Write a number with so many decimals."""
    if value is None or not math.isfinite(value):
        return NONE
    return f"{value:.{places}f}".replace("-", "−")


LARGEST_MAG, LARGEST_ANGLE_DEG = 1.5, 60.0
"""Errors of a magnitude and of an angle beyond which either may have any value."""


def measured(value: float | None, error: float | None, unit: str = "") -> str:
    """Write a number and its error, both to the error's second digit."""
    if value is None or not math.isfinite(value):
        return NONE
    if error is None or not math.isfinite(error) or error <= 0.0:
        return f"{plain(value, 4)}{unit}"
    places = places_of(error)
    if places > 6:
        power = _power(max(abs(value), error))
        places = max(0, places_of(error / 10.0**power))
        scaled = f"({value / 10.0**power:.{places}f}{PLUS_MINUS}{error / 10.0**power:.{places}f})"
        return f"{scaled}{TIMES}10{str(power).translate(SUPERSCRIPT)}{unit}".replace("-", "−")
    both = f"{value:.{max(places, 0)}f}{PLUS_MINUS}{error:.{max(places, 0)}f}"
    return f"{both}{unit}".replace("-", "−")


def known(value: float, error: float | None, unit: str, largest: float) -> str:
    """Write a number with its error, or where that is larger than all there is the number alone."""
    if error is None or error <= largest:
        return measured(value, error, unit)
    return f"{plain(value, 2)}{unit} (undetermined)"


def places_of(error: float) -> int:
    """Decimals that show two digits of an error."""
    return 1 - _power(float(f"{error:.1e}"))


def _power(value: float) -> int:
    return math.floor(math.log10(abs(value)))


def chance(probability: float) -> str:
    """Write a probability; 0 and 1 are written as such."""
    if 0.001 <= probability < 0.01:
        return plain(probability, 2)
    if 0.01 <= probability <= 0.99:
        return f"{100.0 * probability:.2g}\u00a0%"
    return plain(probability, 2)


FARTHEST_TOLD = 1e-10
"""Extrapolated probabilities below this have no number: thousands of draws say that they are
small, and laws fitted to them no more."""


def tail(probability: float | None) -> str:
    """Write a probability of chance, where 0 is a number that is too small for the machine."""
    if probability is not None and probability < LEAST_TOLD:
        return f"<\u00a0{plain(LEAST_TOLD, 1)}"
    return plain(probability, 2)


def percent(share: float) -> str:
    """Write a share as everywhere: 95 %."""
    return f"{100.0 * share:.0f} %"


def count(number: int, one: str, many: str | None = None) -> str:
    """Write a number of things: 1 mode, 2 modes, 10 000 draws."""
    written = f"{number:,}".replace(",", "\u202f")
    return f"{written} {one if number == 1 else many or one + 's'}"


def sentence(text: str) -> str:
    """Begin with a capital and end with a stop."""
    text = capital(text.strip())
    return text if text.endswith((".", "!", "?")) else text + "."


def capital(text: str) -> str:
    """Begin with a capital, and leave names as they are."""
    return text[:1].upper() + text[1:]


def with_error(value: float, error: float, unit: str = "", largest: float = math.inf) -> str:
    """Write a number and its error, both to the error's second digit.

    An error above ``largest`` says that nothing is known.
    """
    if not math.isfinite(error) or error > largest:
        return "undetermined"
    places = max(0, places_of(error)) if error > 0.0 else 4
    return f"{value:.{places}f} +/- {error:.{places}f}{unit}"


def with_sides(median: float, low: float, high: float) -> str:
    """Write a median and the sides of its interval, to the second digit of the smaller one."""
    below, above = median - low, high - median
    if above + below > OPEN_SHARE * abs(median):
        return f"{low:.3g} to {high:.3g}"
    least = min((x for x in (below, above) if x > 0.0), default=0.0)
    places = max(0, places_of(least)) if least > 0.0 else 4
    return f"{median:.{places}f} +{above:.{places}f} -{below:.{places}f}"


OPEN_SHARE = 1.0
"""An interval wider than this share of its median has no middle worth stating: its ends are."""

OPEN_ANGLE_DEG = 180.0
"""A 68 % interval of position angles wider than this leaves every direction open."""


def three_digits(value: float) -> str:
    """A reduced χ²: three digits that count, more only where it is large."""
    return f"{value:.0f}" if value >= 100.0 else f"{value:#.3g}"
