"""Arguments at the public edges: quantities become numbers, and unusable ones a line that says so.

A public function or container is marked by `checks_arguments`. What an argument may be is its
annotation, which mypy reads too; here it is held against what a user gives in a notebook.
"""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Callable, Collection, Mapping
from functools import cached_property, wraps
from typing import Any, TypeVar, cast

from amibayes.errors import UsageError
from amibayes.support.annotations import describe, fits, wanted
from amibayes.support.quantities import has_unit, plain

Target = TypeVar("Target", bound=Callable[..., Any])

MAX_NAMES = 12
"""Arguments that a message lists."""

REMEDIES = {
    ("Observables", "Likelihood"): "make one: amibayes.Likelihood(observables)",
    ("Observables", "SearchResult"): "make one: amibayes.search(amibayes.Likelihood(observables))",
    ("Likelihood", "Observables"): "its observables are likelihood.observables",
    ("Likelihood", "SearchResult"): "make one: amibayes.search(likelihood)",
    ("Likelihood", "Statistic"): "make one: amibayes.statistic_of(amibayes.search(likelihood))",
    ("SearchResult", "Likelihood"): "its likelihood is result.likelihood",
    ("SearchResult", "Statistic"): "make one: amibayes.statistic_of(result)",
    ("SearchReport", "SearchResult"): "its search is report.result",
    ("Significance", "Statistic"): "its statistic is significance.test",
    ("str", "Observables"): "make one: amibayes.read_oifits(path)",
    ("str", "Likelihood"): "make one: amibayes.Likelihood(amibayes.read_oifits(path))",
    ("str", "Cube"): "make one: amibayes.read_cube(path)",
    ("str", "Instrument"): "make one: amibayes.load_instrument(name, filter)",
    ("str", "Scene"): "make one: amibayes.load_scene(path)",
    ("int", "Generator"): "make one: numpy.random.default_rng(seed)",
    ("NoneType", "Generator"): "make one: numpy.random.default_rng(seed)",
}
"""What makes the thing that is wanted of what was given, by the names of their classes."""


def checks_arguments(target: Target) -> Target:
    """Let a function, or the constructor of a class, take quantities and refuse unusable values.

    An argument that its annotation does not allow, a number that is NaN where the default is
    not, and a name that there is not are a `UsageError` that names the argument.
    """
    if isinstance(target, type):
        target.__init__ = _checking(target.__init__, target.__name__)  # type: ignore[misc]
        return target
    return cast(Target, _checking(target, getattr(target, "__name__", "")))


def _checking(function: Callable[..., Any], name: str) -> Callable[..., Any]:
    edge = _Edge(function, name)

    @wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        arguments = edge.bound(args, kwargs)
        if any(has_unit(value) for value in arguments.arguments.values()):
            for key, value in arguments.arguments.items():
                arguments.arguments[key] = plain(key, value)
        for key, value in arguments.arguments.items():
            edge.check(key, value)
        return function(*arguments.args, **arguments.kwargs)

    return checked


class _Edge:
    """A public function: its name, signature and what its arguments may be."""

    def __init__(self, function: Callable[..., Any], name: str) -> None:
        self.function, self.name = function, name

    @cached_property
    def signature(self) -> inspect.Signature:
        return inspect.signature(self.function)

    @cached_property
    def hints(self) -> Mapping[str, Any]:
        """Annotations; those of names that are for type checkers only are left out."""
        known = self.function.__globals__
        hints = {}
        for key, one in self.signature.parameters.items():
            # Further settings and positional ones are the function's own to check.
            plain_kind = one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL)
            if isinstance(one.annotation, str) and plain_kind:
                hints[key] = _evaluated(one.annotation, known)
        return {key: hint for key, hint in hints.items() if hint is not None}

    def bound(self, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> inspect.BoundArguments:
        """Match arguments to their names; `UsageError` for a name that there is not."""
        try:
            return self.signature.bind(*args, **kwargs)
        except TypeError as error:
            known = [key for key in self.signature.parameters if key != "self"]
            for key in kwargs:
                if key not in known:
                    raise UsageError(
                        f"has no argument {key}", source=self.name, remedy=_suggested(key, known)
                    ) from error
            raise UsageError(f"{error}", source=self.name) from error

    def check(self, key: str, value: Any) -> None:
        """Refuse a value that its annotation does not allow, or that is not a number."""
        hint = self.hints.get(key)
        if hint is None:
            return
        if not fits(value, hint):
            what = f"{key} is {describe(value)}, not {wanted(hint)}"
            raise UsageError(what, source=self.name, remedy=_remedy(key, value, hint))
        default = self.signature.parameters[key].default
        if _is_nan(value) and not _is_nan(default):
            raise UsageError(f"{key} is NaN", source=self.name, remedy="give a number")


def _evaluated(annotation: str, known: Mapping[str, Any]) -> Any:
    """Object of an annotation, by the names of its module; None where some are not there."""
    try:
        return eval(annotation, dict(known))  # noqa: S307 - the package's own source text
    except NameError:
        return None


def _is_nan(value: Any) -> bool:
    """Whether a value is a number that is none, or a pair with one."""
    if isinstance(value, tuple | list):
        return any(_is_nan(part) for part in value)
    return isinstance(value, float) and math.isnan(value)


def _remedy(key: str, value: Any, hint: Any) -> str:
    """What makes the thing that is wanted of the thing that was given, where that is known."""
    if fits([value], hint):
        return f"put it into a list: [{key}]"
    return REMEDIES.get((type(value).__name__, getattr(hint, "__name__", "")), "")


def _suggested(key: str, known: list[str]) -> str:
    """The nearest of some names; all of them where none is near and they are few."""
    if near := difflib.get_close_matches(key, known, n=1):
        return f"did you mean {near[0]}?"
    return f"it has {', '.join(known)}" if len(known) <= MAX_NAMES else "see its help"


def in_range(
    owner: str,
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
) -> None:
    """Refuse a number below, above or not within finite limits; words such as "free" pass.

    Raises
    ------
    UsageError
        Naming the owner and the argument.
    """
    if value is None or isinstance(value, str):
        return
    if not (math.isfinite(value) and low <= value <= high):
        ends = [f"at least {low:g}"] * math.isfinite(low) + [f"at most {high:g}"] * (high < 1e300)
        raise UsageError(
            f"{name} is {value:g}", source=owner, remedy=" and ".join(ends) or "give a finite one"
        )


def one_of(owner: str, name: str, value: Any, known: Collection[Any]) -> None:
    """Refuse what is not among the known.

    Raises
    ------
    UsageError
        Naming the owner, the argument and what is known.
    """
    if value not in known:
        raise UsageError(
            f"{name} has {describe(value)}",
            source=owner,
            remedy=f"choose from {', '.join(str(one) for one in known)}",
        )


def annulus(owner: str, name: str, value: tuple[float, float] | None) -> None:
    """Refuse a range of separations that is no annulus.

    Raises
    ------
    UsageError
        Unless 0 ≤ inner < outer < ∞.
    """
    if value is not None and not 0.0 <= value[0] < value[1] < math.inf:
        raise UsageError(
            f"{name} is {value[0]:g} to {value[1]:g}",
            source=owner,
            remedy="give an inner one from 0 and a larger, finite outer one, in mas",
        )
