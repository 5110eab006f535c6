"""amibayes: Bayesian inference for aperture masking interferometry.

Public names are loaded when they are first used (PEP 562), so that importing the
package, and starting the command line, costs nothing. They are listed in ``__init__.pyi``,
once for the interpreter and for type checkers.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
